# SPDX-License-Identifier: Apache-2.0
"""Functions for the launch files; needs ROS's launch."""

import atexit
import os
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node, PushRosNamespace
from launch_ros.substitutions import FindPackageShare

from starpos.files import rows_of
from starpos_bringup.launch_arguments import LaunchError, is_true, names, one_of

if TYPE_CHECKING:
    from launch import LaunchDescriptionEntity

LOG_LEVELS = ("debug", "info", "warn", "error", "fatal")
RESPAWN_DELAY_S = 2.0
# Topics of the solver whose names drivers of GNSS and IMUs have, too.
OUTPUTS = ("fix", "fix_averaged", "heading/imu")
# The variable until Jazzy, and the one after it.
PROFILES = ("FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE")
QUICK_START = PathJoinSubstitution([FindPackageShare("starpos_bringup"), "config", "quick_start.xml"])


def described(
    file: str, entities: Callable[[Mapping[str, str]], "list[LaunchDescriptionEntity]"]
) -> LaunchDescription:
    """Describe a launch: `entities` makes what is started from the values of the file's arguments, in their namespace."""
    rows = rows_of(Path(__file__).with_name("data") / "launch.yaml")[file]

    def default(row: Mapping[str, str]) -> str | PathJoinSubstitution | None:
        if "share" in row:
            return PathJoinSubstitution([FindPackageShare("starpos_bringup"), *row["share"].split("/")])
        return row.get("default")

    def started(context: Any) -> "list[LaunchDescriptionEntity]":
        return entities({name: LaunchConfiguration(name).perform(context) for name in rows})

    return LaunchDescription(
        [
            *(
                DeclareLaunchArgument(n, default_value=default(r), description=r["text"])
                for n, r in rows.items()
            ),
            PushRosNamespace(LaunchConfiguration("namespace")),
            OpaqueFunction(function=started),
        ]
    )


def clock_of(told: Mapping[str, str]) -> dict[str, dict[str, bool]]:
    """The parameter use_sim_time of all nodes, where the argument states it."""
    return {"**": {"use_sim_time": is_true(told, "use_sim_time")} if told["use_sim_time"] else {}}


def dashboard(told: Mapping[str, str], parameters: Mapping[str, Mapping] = {}) -> list[Node]:
    """Make the process of the web page, if it is wanted."""
    wanted = is_true(told, "dashboard")
    return [process("starpos_dashboard", "dashboard", told, parameters)] if wanted else []


# Package and executable of each process of an instrument; camera and detector are one.
INSTRUMENT = (
    ("starpos_camera", "camera_detector"),
    ("starpos_inclinometer", "inclinometer"),
    ("starpos_solver", "solver"),
)


def instrument(
    told: Mapping[str, str], parameters: Mapping[str, Mapping] = {}, defaults: Mapping[str, Mapping] = {}
) -> list[Node]:
    """Make the processes of an instrument; parameters and defaults of all its nodes as in `process`."""
    return [
        process(package, executable, told, parameters, defaults=defaults)
        for package, executable in INSTRUMENT
    ]


def process(
    package: str,
    executable: str,
    told: Mapping[str, str],
    parameters: Mapping[str, Mapping] = {},
    arguments: Sequence[str] = (),
    defaults: Mapping[str, Mapping] = {},
    remaps: Mapping[str, str] = {},
    **options: Any,
) -> Node:
    """Make a process; LaunchError if an argument is wrong.

    The first mapping has the values of the launch file's arguments.
    parameters, defaults: of nodes, by name ('**' is all), of which each takes its own; the parameter file counts less
    than parameters, more than defaults.  remaps: topics by the names that the nodes know them by.
    """
    renamed = [word for name, topic in remaps.items() for word in ("-r", f"{name}:={topic}")]
    # launch_ros only warns of a missing file, and the instrument would run with defaults
    file = Path(told["params_file"]).expanduser()
    if not file.is_file():
        raise LaunchError(f"params_file:={told['params_file']}: there is no such file")
    files = [_written(defaults), str(file), _written(parameters)]
    return Node(
        package=package,
        executable=executable,
        parameters=[file for file in files if file],
        arguments=[*arguments, *ros_arguments(executable, told), *renamed],
        output="screen",
        respawn="respawn" in told and is_true(told, "respawn"),
        respawn_delay=RESPAWN_DELAY_S,
        additional_env=profile(),
        **options,
    )


def profile() -> dict[str, PathJoinSubstitution]:
    """Variables that make nodes on Fast DDS find each other at once; none if the user has profiles of their own."""
    return {} if any(name in os.environ for name in PROFILES) else dict.fromkeys(PROFILES, QUICK_START)


def ros_arguments(executable: str, told: Mapping[str, str]) -> list[str]:
    """Make the arguments for ROS; the enclave is only a name while security is not enabled (ROS_SECURITY_ENABLE)."""
    enclave = f"{told['enclaves'].rstrip('/')}/{executable}"
    outputs = names(told, "outputs")[:1] if told["outputs"] else []
    remaps = [word for below in outputs for name in OUTPUTS for word in ("-r", f"{name}:={below}/{name}")]
    return ["--ros-args", "--log-level", one_of(told, "log_level", LOG_LEVELS), "--enclave", enclave, *remaps]


def _written(parameters: Mapping[str, Mapping]) -> str:
    """Write a parameter file that is deleted at the end of this process; return its path, '' without parameters.

    A `-p` cannot do this: it reaches all nodes of a process, or one without a namespace.
    """
    content = {
        ("/**" if name == "**" else f"/**/{name}"): {"ros__parameters": dict(values)}
        for name, values in parameters.items()
        if values
    }
    if not content:
        return ""
    with tempfile.NamedTemporaryFile("w", prefix="starpos_", suffix=".yaml", delete=False) as file:
        yaml.safe_dump(content, file)
    atexit.register(Path(file.name).unlink, missing_ok=True)
    return file.name

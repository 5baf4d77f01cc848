# SPDX-License-Identifier: Apache-2.0
"""What the launch files have in common; imported where ROS's launch is."""

import atexit
import os
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import yaml
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

COMMON_ARGUMENTS = (  # name, default, what it is
    ("namespace", "", "moves the whole instrument: /NAMESPACE/fix and so on"),
    (
        "params_file",
        PathJoinSubstitution([FindPackageShare("starpos_bringup"), "config", "starpos.yaml"]),
        "parameters of all nodes",
    ),
    ("log_level", "info", "debug, info, warn or error"),
    (
        "enclaves",
        "/starpos",
        "where the SROS2 enclaves are: each process has enclaves/EXECUTABLE, if security is enabled",
    ),
)
RESPAWN_DELAY_S = 2.0
PROFILES = ("FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE")  # until Jazzy, and after
QUICK_START = PathJoinSubstitution([FindPackageShare("starpos_bringup"), "config", "quick_start.xml"])


class LaunchError(Exception):
    """An argument is not what it must be: one sentence."""


@dataclass(frozen=True)
class Common:
    """What all processes of a launch share; params_file: '' for none."""

    params_file: str
    log_level: str
    enclaves: str
    respawn: bool = False

    @classmethod
    def of(cls, told: Mapping[str, str]) -> "Common":
        """From the arguments; LaunchError where there is no such parameter file."""
        # launch_ros only warns of one that is not there, and the instrument would run with defaults
        path = Path(told["params_file"]).expanduser()
        if not path.is_file():
            raise LaunchError(f"params_file:={told['params_file']}: there is no such file")
        respawn = is_true(told, "respawn") if "respawn" in told else False
        return cls(str(path), told["log_level"], told["enclaves"].rstrip("/"), respawn)


def is_true(told: Mapping[str, str], name: str) -> bool:
    """What an argument says; LaunchError where it is neither true nor false."""
    words = {"true": True, "1": True, "false": False, "0": False}
    try:
        return words[told[name].lower()]
    except KeyError:
        raise LaunchError(f"{name}:={told[name]}: give true or false") from None


def declared(arguments) -> list[DeclareLaunchArgument]:
    """Launch's own form of them."""
    return [
        DeclareLaunchArgument(name, default_value=value, description=text) for name, value, text in arguments
    ]


def given(context, arguments) -> dict[str, str]:
    """What the arguments are, as text."""
    return {name: LaunchConfiguration(name).perform(context) for name, _, _ in arguments}


def process(
    package: str,
    executable: str,
    common: Common,
    parameters: Mapping[str, Mapping] = {},
    arguments: Sequence[str] = (),
    **options,
) -> Node:
    """An executable with its nodes' parameters: a file's, and over it some of each node (by its name; '**' is all)."""
    files = [common.params_file]
    parameters = {name: dict(values) for name, values in parameters.items() if values}
    if parameters:
        files.append(_written(parameters))
    return Node(
        package=package,
        executable=executable,
        parameters=files,
        arguments=[*arguments, *ros_arguments(executable, common)],
        output="screen",
        respawn=common.respawn,
        respawn_delay=RESPAWN_DELAY_S,
        additional_env=profile(),
        **options,
    )


def profile() -> dict[str, PathJoinSubstitution]:
    """The variables that make nodes on Fast DDS find each other at once; none where the user has profiles of his own."""
    return {} if any(name in os.environ for name in PROFILES) else dict.fromkeys(PROFILES, QUICK_START)


def ros_arguments(executable: str, common: Common) -> list[str]:
    """The enclave is but a name while security is not enabled (ROS_SECURITY_ENABLE)."""
    enclave = f"{common.enclaves}/{executable}"
    return ["--ros-args", "--log-level", common.log_level, "--enclave", enclave]


def _written(parameters: Mapping[str, Mapping]) -> str:
    """A parameter file, gone with this process: a -p reaches all nodes of a process, or one of no namespace."""
    content = {
        ("/**" if name == "**" else f"/**/{name}"): {"ros__parameters": values}
        for name, values in parameters.items()
    }
    with tempfile.NamedTemporaryFile("w", prefix="starpos_", suffix=".yaml", delete=False) as file:
        yaml.safe_dump(content, file)
    atexit.register(lambda: os.path.exists(file.name) and os.unlink(file.name))
    return file.name

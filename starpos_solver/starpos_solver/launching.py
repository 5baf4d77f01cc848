# SPDX-License-Identifier: Apache-2.0
"""What the launch files have in common; imported where ROS's launch is."""

import atexit
import os
import tempfile
from collections.abc import Mapping, Sequence

import yaml
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

COMMON_ARGUMENTS = (  # name, default, what it is
    ("namespace", "", "moves the whole instrument: /NAMESPACE/fix and so on"),
    (
        "params_file",
        PathJoinSubstitution([FindPackageShare("starpos_solver"), "config", "starpos.yaml"]),
        "parameters of all nodes",
    ),
    ("log_level", "info", "debug, info, warn or error"),
)


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
    params_file: str,
    log_level: str,
    parameters: Mapping[str, Mapping] = {},
    arguments: Sequence[str] = (),
    **options,
) -> Node:
    """An executable with its nodes' parameters: a file's, and over it some of each node (by its name; '**' is all)."""
    files = [params_file] if params_file else []
    parameters = {name: dict(values) for name, values in parameters.items() if values}
    if parameters:
        files.append(_written(parameters))
    ros = ["--ros-args", "--log-level", log_level] if log_level else []
    return Node(
        package=package,
        executable=executable,
        parameters=files,
        arguments=[*arguments, *ros],
        output="screen",
        **options,
    )


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

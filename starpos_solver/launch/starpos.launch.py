# SPDX-License-Identifier: Apache-2.0
"""The instrument: camera, detector, inclinometer, solver.

    ros2 launch starpos_solver starpos.launch.py port:=/dev/serial/by-id/... params_file:=mine.yaml

An argument that is not given leaves what the parameter file says.
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node, PushRosNamespace
from launch_ros.substitutions import FindPackageShare

OWN_PARAMETERS = PathJoinSubstitution([FindPackageShare("starpos_solver"), "config", "starpos.yaml"])
ARGUMENTS = (
    ("namespace", "", "moves the whole instrument: /NAMESPACE/fix and so on"),
    ("params_file", OWN_PARAMETERS, "parameters of all nodes"),
    ("use_sim_time", "", "true: time from /clock, for replays"),
    ("camera", "", "source of frames: files or simulated"),
    ("port", "", "serial port of the inclinometer; prefer a path under /dev/serial/by-id"),
    ("log_level", "info", "debug, info, warn or error"),
)
NODES = (  # package, executable, the argument that is one of its parameters
    ("starpos_camera", "camera", {"source": "camera"}),
    ("starpos_camera", "detector", {}),
    ("starpos_inclinometer", "inclinometer", {"port": "port"}),
    ("starpos_solver", "solver", {}),
)


def nodes(context):
    given = {name: LaunchConfiguration(name).perform(context) for name, _, _ in ARGUMENTS}
    clock = {"use_sim_time": given["use_sim_time"].lower() == "true"} if given["use_sim_time"] else {}
    return [
        Node(
            package=package,
            executable=executable,
            name=executable,
            parameters=[
                given["params_file"],
                clock | {parameter: given[a] for parameter, a in arguments.items() if given[a]},
            ],
            arguments=["--ros-args", "--log-level", given["log_level"]],
            output="screen",
        )
        for package, executable, arguments in NODES
    ]


def generate_launch_description():
    declared = (
        DeclareLaunchArgument(name, default_value=value, description=text) for name, value, text in ARGUMENTS
    )
    return LaunchDescription(
        [*declared, PushRosNamespace(LaunchConfiguration("namespace")), OpaqueFunction(function=nodes)]
    )

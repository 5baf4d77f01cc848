# SPDX-License-Identifier: Apache-2.0
"""The instrument: camera, detector, inclinometer, solver.

ros2 launch starpos_solver starpos.launch.py port:=/dev/serial/by-id/... params_file:=mine.yaml
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node, PushRosNamespace
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

ARGUMENTS = (
    ("namespace", "", "moves the whole instrument: /NAMESPACE/fix and so on"),
    (
        "params_file",
        PathJoinSubstitution([FindPackageShare("starpos_solver"), "config", "starpos.yaml"]),
        "parameters",
    ),
    ("use_sim_time", "false", "time from /clock, for replays"),
    ("camera", "files", "source of frames: files or simulated"),
    ("port", "/dev/ttyUSB0", "serial port of the inclinometer; prefer a path under /dev/serial/by-id"),
    ("log_level", "info", "debug, info, warn or error"),
)


def generate_launch_description():
    set_to = LaunchConfiguration

    def node(package, executable, **parameters):
        given = {"use_sim_time": ParameterValue(set_to("use_sim_time"), value_type=bool), **parameters}
        return Node(
            package=package,
            executable=executable,
            name=executable,
            parameters=[set_to("params_file"), given],
            arguments=["--ros-args", "--log-level", set_to("log_level")],
            output="screen",
        )

    return LaunchDescription(
        [
            *(
                DeclareLaunchArgument(name, default_value=value, description=text)
                for name, value, text in ARGUMENTS
            ),
            PushRosNamespace(set_to("namespace")),
            node("starpos_camera", "camera", source=set_to("camera")),
            node("starpos_camera", "detector"),
            node("starpos_inclinometer", "inclinometer", port=set_to("port")),
            node("starpos_solver", "solver"),
        ]
    )

# SPDX-License-Identifier: Apache-2.0
"""Detector, inclinometer and solver on the camera and the IMU that a robot has.

    ros2 launch starpos_bringup robot.launch.py image:=/cam0/image_raw imu:=/imu/data params_file:=robot.yaml

`camera_info:=` names the intrinsics. The file states what the drivers do not: begin with a copy of
config/existing_robot.yaml.
"""

from launch import LaunchDescription
from launch.actions import OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import PushRosNamespace

from starpos_bringup.launch_arguments import is_true
from starpos_bringup.launching import COMMON_ARGUMENTS, Common, declared, given, process

ARGUMENTS = (
    ("image", None, "the camera's topic, sensor_msgs/Image, or the one whose /compressed is sent"),
    ("camera_info", None, "the topic of its intrinsics"),
    ("imu", None, "the IMU's topic, sensor_msgs/Imu with accelerations"),
    (
        "params_file",
        None,
        "parameters of the nodes: a copy of config/existing_robot.yaml, with your own values",
    ),
    (
        "namespace",
        "starpos",
        "of what the nodes publish: /NAMESPACE/fix, so that it is not mixed with a GNSS receiver's",
    ),
    *(argument for argument in COMMON_ARGUMENTS if argument[0] not in ("params_file", "namespace")),
    ("use_sim_time", "", "true: time from /clock, for a bag"),
    ("dashboard", "false", "true: also the web page, at http://127.0.0.1:8042"),
    ("respawn", "false", "true: a process that ends, for whatever reason, is started again 2 s later"),
)


def nodes(context):
    told = given(context, ARGUMENTS)
    common = Common.of(told)
    clock = {"use_sim_time": is_true(told, "use_sim_time")} if told["use_sim_time"] else {}
    every = {"**": clock}
    camera_info, imu = {"camera/camera_info": told["camera_info"]}, {"imu/data": told["imu"]}
    frames = {"camera/image_raw": told["image"], **camera_info, **imu}
    source = every | {"inclinometer": {"source": "imu"}}
    processes = [
        process("starpos_camera", "detector", common, every, remaps=frames),
        process("starpos_inclinometer", "inclinometer", common, source, remaps=imu),
        process("starpos_solver", "solver", common, every, remaps=camera_info | imu),
    ]
    if is_true(told, "dashboard"):
        processes.append(process("starpos_dashboard", "dashboard", common, every))
    return processes


def generate_launch_description():
    return LaunchDescription(
        [
            *declared(ARGUMENTS),
            PushRosNamespace(LaunchConfiguration("namespace")),
            OpaqueFunction(function=nodes),
        ]
    )

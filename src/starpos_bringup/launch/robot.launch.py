# SPDX-License-Identifier: Apache-2.0
"""Detector, inclinometer and solver on the camera and the IMU that a robot has.

    ros2 launch starpos_bringup robot.launch.py image:=/cam0/image_raw imu:=/imu/data params_file:=robot.yaml

`camera_info:=` names the intrinsics. The file states what the drivers do not: begin with a copy of
config/existing_robot.yaml.
"""

from starpos_bringup import launching

ARGUMENTS = (
    ("image", None, "the camera's topic, sensor_msgs/Image, or the one whose /compressed is sent"),
    ("camera_info", None, "the topic of its intrinsics"),
    ("imu", None, "the IMU's topic, sensor_msgs/Imu with accelerations"),
    *launching.COMMON_ARGUMENTS,
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
    *launching.LIVE_ARGUMENTS,
    launching.DASHBOARD_ARGUMENT,
)


def nodes(told):
    common, every = launching.Common.of(told), launching.clock_of(told)
    camera_info, imu = {"camera/camera_info": told["camera_info"]}, {"imu/data": told["imu"]}
    frames = {"camera/image_raw": told["image"], **camera_info, **imu}
    source = every | {"inclinometer": {"source": "imu"}}
    return [
        launching.process("starpos_camera", "detector", common, every, remaps=frames),
        launching.process("starpos_inclinometer", "inclinometer", common, source, remaps=imu),
        launching.process("starpos_solver", "solver", common, every, remaps=camera_info | imu),
        *launching.dashboard(told, common, every),
    ]


def generate_launch_description():
    return launching.described(ARGUMENTS, nodes)

# SPDX-License-Identifier: Apache-2.0
"""Detector, inclinometer and solver on the camera and the IMU that a robot has.

    ros2 launch starpos_bringup robot.launch.py image:=/cam0/image_raw imu:=/imu/data params_file:=robot.yaml

`camera_info:=` names the intrinsics. The file states what the drivers do not: begin with a copy of
config/existing_robot.yaml.
"""

from starpos_bringup import launching


def nodes(told):
    every = launching.clock_of(told)
    camera_info, imu = {"camera/camera_info": told["camera_info"]}, {"imu/data": told["imu"]}
    frames = {"camera/image_raw": told["image"], **camera_info, **imu}
    source = every | {"inclinometer": {"source": "imu"}}
    return [
        launching.process("starpos_camera", "detector", told, every, remaps=frames),
        launching.process("starpos_inclinometer", "inclinometer", told, source, remaps=imu),
        launching.process("starpos_solver", "solver", told, every, remaps=camera_info | imu),
        *launching.dashboard(told, every),
    ]


def generate_launch_description():
    return launching.described("robot", nodes)

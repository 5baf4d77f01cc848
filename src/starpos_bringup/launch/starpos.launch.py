# SPDX-License-Identifier: Apache-2.0
"""The instrument: camera and detector in one process, inclinometer, solver.

    ros2 launch starpos_bringup starpos.launch.py port:=/dev/serial/by-id/... params_file:=robot.yaml

Without an argument the value of the parameter file holds.
"""

from launch import LaunchDescription
from launch.actions import OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import PushRosNamespace

from starpos_bringup.launch_arguments import is_true
from starpos_bringup.launching import COMMON_ARGUMENTS, Common, declared, given, instrument, process

ARGUMENTS = (
    *COMMON_ARGUMENTS,
    ("use_sim_time", "", "true: time from /clock"),
    ("camera", "", "source of frames: files, simulated, gphoto2, indi, alpaca, video"),
    ("port", "", "serial port of the inclinometer; prefer a path under /dev/serial/by-id"),
    ("navigator", "false", "true: also the place under way, by an IMU on imu/data"),
    ("dashboard", "false", "true: also the web page, at http://127.0.0.1:8042"),
    ("respawn", "false", "true: a process that ends, for whatever reason, is started again 2 s later"),
)


def nodes(context):
    told = given(context, ARGUMENTS)
    clock = {"use_sim_time": is_true(told, "use_sim_time")} if told["use_sim_time"] else {}
    source = {"source": told["camera"]} if told["camera"] else {}
    port = {"port": told["port"]} if told["port"] else {}
    common = Common.of(told)
    processes = instrument(common, {"**": clock, "camera": source, "inclinometer": port})
    if is_true(told, "navigator"):
        processes.append(process("starpos_solver", "navigator", common, {"**": clock}))
    if is_true(told, "dashboard"):
        processes.append(process("starpos_dashboard", "dashboard", common, {"**": clock}))
    return processes


def generate_launch_description():
    return LaunchDescription(
        [
            *declared(ARGUMENTS),
            PushRosNamespace(LaunchConfiguration("namespace")),
            OpaqueFunction(function=nodes),
        ]
    )

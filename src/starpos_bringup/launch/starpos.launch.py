# SPDX-License-Identifier: Apache-2.0
"""The instrument: camera and detector in one process, inclinometer, solver.

    ros2 launch starpos_bringup starpos.launch.py port:=/dev/serial/by-id/... params_file:=robot.yaml

Without an argument the value of the parameter file holds.
"""

from starpos_bringup.launch_arguments import is_true
from starpos_bringup.launching import (
    COMMON_ARGUMENTS,
    DASHBOARD_ARGUMENT,
    LIVE_ARGUMENTS,
    Common,
    clock_of,
    dashboard,
    described,
    instrument,
    process,
)

ARGUMENTS = (
    *COMMON_ARGUMENTS,
    *LIVE_ARGUMENTS,
    ("camera", "", "source of frames: files, simulated, gphoto2, indi, alpaca, video"),
    ("port", "", "serial port of the inclinometer; prefer a path under /dev/serial/by-id"),
    ("navigator", "false", "true: also the place under way, by an IMU on imu/data"),
    DASHBOARD_ARGUMENT,
)


def nodes(told):
    source = {"source": told["camera"]} if told["camera"] else {}
    port = {"port": told["port"]} if told["port"] else {}
    common, every = Common.of(told), clock_of(told)
    processes = instrument(common, every | {"camera": source, "inclinometer": port})
    if is_true(told, "navigator"):
        processes.append(process("starpos_solver", "navigator", common, every))
    return [*processes, *dashboard(told, common, every)]


def generate_launch_description():
    return described(ARGUMENTS, nodes)

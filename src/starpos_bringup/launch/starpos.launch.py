# SPDX-License-Identifier: Apache-2.0
"""The instrument: camera and detector in one process, inclinometer, solver.

    ros2 launch starpos_bringup starpos.launch.py port:=/dev/serial/by-id/... params_file:=robot.yaml

Without an argument the value of the parameter file holds.
"""

from starpos_bringup import launching
from starpos_bringup.launch_arguments import is_true


def nodes(told):
    source = {"source": told["camera"]} if told["camera"] else {}
    port = {"port": told["port"]} if told["port"] else {}
    every = launching.clock_of(told)
    processes = launching.instrument(told, every | {"camera": source, "inclinometer": port})
    if is_true(told, "navigator"):
        processes.append(launching.process("starpos_solver", "navigator", told, every))
    return [*processes, *launching.dashboard(told, every)]


def generate_launch_description():
    return launching.described("starpos", nodes)

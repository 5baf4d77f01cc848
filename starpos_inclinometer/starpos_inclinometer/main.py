# SPDX-License-Identifier: Apache-2.0
"""The executables. Their imports are heavy, so they come after the signal handlers (see starpos_common)."""

import sys
from collections.abc import Iterator
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rclpy.node import Node


def inclinometer() -> int:
    """Run the node."""
    from starpos_common.node_main import run

    def make_nodes() -> "Iterator[Node]":
        from starpos_inclinometer.node import InclinometerNode

        yield InclinometerNode()

    def help_text() -> str:
        from starpos_common.parameters import node_help

        about = "The readings of an inclinometer, or of an IMU, on `tilt`, until Ctrl-C."
        return node_help("starpos_inclinometer", "inclinometer", about, "inclinometer")

    return run(make_nodes, help_text=help_text)


def emulator() -> int:
    """Run the emulated microcontroller until SIGINT or SIGTERM."""
    from starpos_common.node_main import stop_signals

    with stop_signals() as stopped:
        from starpos_inclinometer.emulator import main

        return main(sys.argv[1:], stopped)

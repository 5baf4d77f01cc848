# SPDX-License-Identifier: Apache-2.0
"""The executable. Its imports are heavy, so they come after the signal handlers (see starpos_common)."""

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

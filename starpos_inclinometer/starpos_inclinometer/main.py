# SPDX-License-Identifier: Apache-2.0
"""The executable. Its imports are heavy, so they come after the signal handlers (see starpos_common)."""

from collections.abc import Iterator
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rclpy.node import Node


def inclinometer() -> int:
    """Run the node."""
    from starpos_common.node_main import run_executable

    def make_nodes() -> "Iterator[Node]":
        from starpos_inclinometer.node import InclinometerNode

        yield InclinometerNode()

    about = "The readings of an inclinometer, or of an IMU, on `tilt`, until Ctrl-C."
    return run_executable("starpos_inclinometer", "inclinometer", about, make_nodes)

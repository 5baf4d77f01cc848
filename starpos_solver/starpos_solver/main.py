# SPDX-License-Identifier: Apache-2.0
"""The executables. Their imports are heavy, so they come after the signal handlers (see starpos_common)."""

from collections.abc import Iterator
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rclpy.node import Node


def solver() -> int:
    """Run the node."""
    from starpos_common.node_main import leave, run_executable

    def make_nodes() -> "Iterator[Node]":
        from starpos_solver.node import SolverNode

        yield SolverNode()

    about = "Stars and tilts in, position and heading out, until Ctrl-C."
    # A thread may still build triangles.
    return leave(run_executable("starpos_solver", "solver", about, make_nodes))


def navigator() -> int:
    """Run the node."""
    from starpos_common.node_main import leave, run_executable

    def make_nodes() -> "Iterator[Node]":
        from starpos_solver.navigator_node import NavigatorNode

        yield NavigatorNode()

    about = "An IMU, attitudes and velocities in, position, heading and velocity under way out, until Ctrl-C."
    # A thread may still adjust.
    return leave(run_executable("starpos_solver", "navigator", about, make_nodes))

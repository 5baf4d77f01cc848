# SPDX-License-Identifier: Apache-2.0
"""The executable. Its imports are heavy, so they come after the signal handlers (see starpos_common)."""

from collections.abc import Iterator
from typing import TYPE_CHECKING

from starpos_common.node_main import leave, run_executable

if TYPE_CHECKING:
    from rclpy.node import Node


def dashboard() -> int:
    """Run the node."""
    about = (
        "The instrument in a browser, at http://127.0.0.1:8042 unless parameters say otherwise, until Ctrl-C."
    )
    return leave(run_executable("starpos_dashboard", "dashboard", about, make_nodes))


def make_nodes() -> "Iterator[Node]":
    """Make the DashboardNode; StarposError if tornado, which serves the page, is not installed."""
    from importlib.util import find_spec

    from starpos.errors import StarposError

    if find_spec("tornado") is None:
        raise StarposError(
            "the dashboard needs tornado, which is not installed: sudo apt install python3-tornado, "
            "or pip install tornado"
        )
    from starpos_dashboard.node import DashboardNode

    yield DashboardNode()

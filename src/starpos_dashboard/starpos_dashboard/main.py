# SPDX-License-Identifier: Apache-2.0
"""The executable. The imports inside are heavy; they come after the signal handlers (see starpos_common)."""


def dashboard() -> int:
    """The node."""
    from starpos_common.node_main import leave, run

    return leave(run(make_nodes))


def make_nodes():
    """A DashboardNode; StarposError where this machine lacks what serves the page."""
    from importlib.util import find_spec

    from starpos.errors import StarposError

    if find_spec("tornado") is None:
        raise StarposError(
            "the dashboard needs tornado, which is not installed: sudo apt install python3-tornado, "
            "or pip install tornado"
        )
    from starpos_dashboard.node import DashboardNode

    yield DashboardNode()

# SPDX-License-Identifier: Apache-2.0
"""The executable. Its imports are heavy, so they come after the signal handlers (see starpos_common)."""

from starpos_common.node_main import leave, run_executable


def dashboard() -> int:
    about = (
        "The instrument in a browser, at http://127.0.0.1:8042 unless parameters say otherwise, until Ctrl-C."
    )
    return leave(run_executable("starpos_dashboard", "dashboard", about, "node:DashboardNode"))

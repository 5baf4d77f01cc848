# SPDX-License-Identifier: Apache-2.0
"""The executables."""

from starpos_common.node_main import leave, run_executable


def solver() -> int:
    about = "Stars and tilts in, position and heading out, until Ctrl-C."
    # A thread may still build triangles.
    return leave(run_executable("starpos_solver", "solver", about, "node:SolverNode"))


def navigator() -> int:
    about = "An IMU, attitudes and velocities in, position, heading and velocity under way out, until Ctrl-C."
    # A thread may still adjust.
    return leave(run_executable("starpos_solver", "navigator", about, "navigator_node:NavigatorNode"))

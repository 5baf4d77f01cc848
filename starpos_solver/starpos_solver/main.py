# SPDX-License-Identifier: Apache-2.0
"""The executable. The imports inside are heavy; they come after the signal handlers (see starpos_common)."""


def solver() -> int:
    """The node."""
    from starpos_common.node_main import leave, run

    def make_nodes():
        from starpos_solver.node import SolverNode

        yield SolverNode()

    return leave(run(make_nodes))  # the triangles may be in the making

# SPDX-License-Identifier: Apache-2.0
"""What tests of the chain from stars and tilt to a solution share."""


def refused(solution, status):
    """The solution has no fix but this status and one sentence."""
    assert solution.status is status
    assert solution.fix is None
    assert not solution.ok
    assert solution.message
    assert "\n" not in solution.message
    return solution.message

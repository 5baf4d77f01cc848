# SPDX-License-Identifier: Apache-2.0
"""How long tests wait."""

import time
from collections.abc import Callable

# Between two looks.
POLL_S = 0.005
# For any event: over ten times the slowest one's time on an idle machine.
WAIT_S = 120.0


def until(condition: Callable[[], object]) -> None:
    """Ask again and again until a condition is true; AssertionError after WAIT_S."""
    end = time.monotonic() + WAIT_S
    while not condition():
        assert time.monotonic() < end, f"waited {WAIT_S:g} s in vain"
        time.sleep(POLL_S)

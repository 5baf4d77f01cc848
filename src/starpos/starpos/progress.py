# SPDX-License-Identifier: Apache-2.0
"""Progress reports of work that takes long."""

from collections.abc import Callable

# Called with a text about the work, and the share that is done, 0..1.
Progress = Callable[[str, float], None]


def quiet(what: str, done: float) -> None:
    """Ignore a progress report."""

# SPDX-License-Identifier: Apache-2.0
"""Progress reports of work that takes long."""

from collections.abc import Callable

# Called with a text that says what is being done, and the share of it that is done, 0..1.
Progress = Callable[[str, float], None]


def quiet(what: str, done: float) -> None:
    """Ignore a progress report."""

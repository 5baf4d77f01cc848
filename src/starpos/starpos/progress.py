# SPDX-License-Identifier: Apache-2.0
"""How long work says how far it is."""

from collections.abc import Callable

Progress = Callable[[str, float], None]  # what is being done, and the share of it that is


def quiet(what: str, done: float) -> None:
    """Progress that nobody watches."""

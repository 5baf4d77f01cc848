# SPDX-License-Identifier: Apache-2.0
"""SIGINT and SIGTERM as wishes that a process looks at when it can, until its interpreter has ended."""

import contextlib
import signal
import sys
from collections.abc import Callable, Iterator
from typing import Any

SIGNALS = (signal.SIGINT, signal.SIGTERM)


@contextlib.contextmanager
def stop_signals() -> Iterator[list[int]]:
    """Give a list that every such signal is added to; after the block they are ignored, for good.

    launch sends a second SIGINT: Python's own handler must not get it while the interpreter ends.
    """
    stopped: list[int] = []
    for number in SIGNALS:
        signal.signal(number, lambda signum, frame: stopped.append(signum))
    try:
        yield stopped
    finally:
        if not isinstance(sys.unraisablehook, _UnlessLate):
            sys.unraisablehook = _UnlessLate(sys.unraisablehook)
        for number in SIGNALS:
            signal.signal(number, signal.SIG_IGN)


class _UnlessLate:
    """A hook for uncaught errors, except from signals that came while they were being ignored.

    Another thread may take a signal before the change and note it after; Python then prints "ignored due to race
    condition". No order of calls prevents it.
    """

    def __init__(self, told: Callable[[Any], Any]) -> None:
        self._told = told

    def __call__(self, unraisable: Any) -> None:
        error = unraisable.exc_value
        if not (isinstance(error, OSError) and "ignored due to race condition" in str(error)):
            self._told(unraisable)

# SPDX-License-Identifier: Apache-2.0
"""SIGINT and SIGTERM as wishes that a process looks at when it can, until its interpreter has ended."""

import contextlib
import ctypes
import signal
from collections.abc import Iterator

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
        for number in SIGNALS:
            ignore(number)


def ignore(number: int) -> None:
    """Ignore a signal from now on, without a word of one that comes meanwhile.

    Of a signal between its look for earlier ones and the change, `signal.signal` prints "ignored due to race
    condition". So the process ignores it first; then Python is told, which would else set the default as it ends.
    """
    ctypes.pythonapi.PyOS_setsig(number, ctypes.c_void_p(signal.SIG_IGN))
    signal.signal(number, signal.SIG_IGN)

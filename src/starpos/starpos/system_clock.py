# SPDX-License-Identifier: Apache-2.0
"""State of this machine's clock from the kernel: whether it is kept to UTC, and how far off it may be.

Source: adjtimex(2). maxerror has NTP's meaning: the largest possible error of the clock (RFC 5905, root distance). It
grows by 500 ppm while nothing corrects the clock. chrony, systemd-timesyncd, ntpd and linuxptp all maintain it.
"""

import ctypes
import math
import struct
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

from starpos.units import DAY_S

STA_UNSYNC = 0x0040
# adjtimex's answer if the clock is not synchronised.
TIME_ERROR = 5
# Ratio of the bound to the standard deviation of a uniform distribution.
UNIFORM = math.sqrt(3)
STEP_S = 0.1
QUICK_S, TRIES = 1e-3, 10
# Standard deviation of a time that may be any time of the day.
UNKNOWN_S = DAY_S / math.sqrt(12)
# More than the quickest slewing in use (chrony's maxslewrate is 0.083); anything quicker is a step.
SLEW = 0.1


# struct timex of <sys/timex.h> begins with modes, offset, freq, maxerror, esterror, status; room for all of it, and more
TIMEX, TIMEX_BYTES = struct.Struct("@Illlli"), 512


@dataclass(frozen=True)
class SystemClock:
    """Whether the clock is kept to UTC, and the kernel's bound and estimate of its error."""

    synchronised: bool
    max_error_s: float
    est_error_s: float

    @property
    def stddev_s(self) -> float:
        """Standard deviation of the clock's error, taken as uniform within the bound.

        While nothing keeps the clock there is no bound (the kernel's number stops at 16 s): any time of day is possible.
        """
        if not self.synchronised:
            return UNKNOWN_S
        return max(self.max_error_s / UNIFORM, self.est_error_s)

    @property
    def sentence(self) -> str:
        if self.synchronised:
            return f"the system's clock is kept to UTC within {self.max_error_s:.2g} s."
        return (
            "the system's clock is not synchronised, so fixes have no valid longitude: start chrony, "
            "systemd-timesyncd or "
            "linuxptp, or set the solver's clock_stddev where you know how good the clock is."
        )


def read() -> SystemClock | None:
    """Read the present state; None if the system does not report it (a container may forbid it)."""
    state = ctypes.create_string_buffer(TIMEX_BYTES)
    try:
        answer = ctypes.CDLL(None, use_errno=True).adjtimex(state)
    except (OSError, AttributeError):
        return None
    if answer < 0:
        return None
    *_, max_error_us, est_error_us, status = TIMEX.unpack_from(state)
    synchronised = answer != TIME_ERROR and not status & STA_UNSYNC
    return SystemClock(synchronised, max_error_us * 1e-6, est_error_us * 1e-6)


def both_clocks(now: Callable[[], float] = time.time) -> tuple[float, float]:
    """Read a clock and the monotonic one at one moment (s), again if something delayed the reading."""
    for _ in range(TRIES):
        before = time.monotonic()
        utc = now()
        after = time.monotonic()
        if after - before < QUICK_S:
            break
    return utc, (before + after) / 2


class StepWatch:
    """Finds steps of the system's clock: it moved against the monotonic clock faster than any slewing.

    Ask at least once a second: over a long time slewing moves a clock as far as a step does.
    clocks: returns (UTC, monotonic) in s at one moment.
    """

    def __init__(self, clocks: Callable[[], tuple[float, float]] = both_clocks) -> None:
        self._clocks = clocks
        # One thread takes frames, another reports.
        self._lock = threading.Lock()
        self._utc, self._monotonic = clocks()
        self._set_s = 0.0

    def step_s(self) -> float:
        """How far the clock was set since the last call (ahead is positive); 0 if it was not set."""
        with self._lock:
            before = self._set_s
            self._look()
            return self._set_s - before

    def set_s(self) -> float:
        """How far the clock was set in total since this watch began, whichever thread asked meanwhile."""
        with self._lock:
            self._look()
            return self._set_s

    def _look(self) -> None:
        utc, monotonic = self._clocks()
        elapsed = monotonic - self._monotonic
        moved = (utc - self._utc) - elapsed
        self._utc, self._monotonic = utc, monotonic
        if abs(moved) > STEP_S + SLEW * elapsed:
            self._set_s += moved

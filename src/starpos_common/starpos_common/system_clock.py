# SPDX-License-Identifier: Apache-2.0
"""What the kernel says of this machine's clock: whether anything keeps it to UTC, and how far off it may be.

Source: adjtimex(2); maxerror is in NTP's sense, the most the clock may be off (RFC 5905, root distance), and grows by
500 ppm while nobody corrects it. chrony, systemd-timesyncd, ntpd and linuxptp all keep it.
"""

import ctypes
import math
import threading
import time
from dataclasses import dataclass

from starpos.units import DAY_S

STA_UNSYNC = 0x0040
TIME_ERROR = 5  # adjtimex's answer of a clock that is not synchronised
UNIFORM = math.sqrt(3)  # bound over standard deviation of what is as likely anywhere within it
STEP_S = 0.1
QUICK_S, TRIES = 1e-3, 10
UNKNOWN_S = DAY_S / math.sqrt(12)  # any time of the day
SLEW = 0.1  # the quickest slewing in use (chrony's maxslewrate is 0.083): more than this is a step


class _Timex(ctypes.Structure):
    """struct timex of <sys/timex.h>."""

    _fields_ = (
        ("modes", ctypes.c_uint),
        *((name, ctypes.c_long) for name in ("offset", "freq", "maxerror", "esterror")),
        ("status", ctypes.c_int),
        *(
            (name, ctypes.c_long)
            for name in ("constant", "precision", "tolerance", "seconds", "microseconds", "tick")
        ),
        *((name, ctypes.c_long) for name in ("ppsfreq", "jitter")),
        ("shift", ctypes.c_int),
        *((name, ctypes.c_long) for name in ("stabil", "jitcnt", "calcnt", "errcnt", "stbcnt")),
        ("tai", ctypes.c_int),
        ("reserved", ctypes.c_int * 11),
    )


@dataclass(frozen=True)
class SystemClock:
    """max_error_s, est_error_s: the kernel's bound and estimate of what the clock is off UTC."""

    synchronised: bool
    max_error_s: float
    est_error_s: float

    @property
    def stddev_s(self) -> float:
        """Standard deviation to claim: of anything within the bound.

        Where nothing keeps the clock there is no bound (the kernel's own number stops at 16 s): any time of the day.
        """
        if not self.synchronised:
            return UNKNOWN_S
        return max(self.max_error_s / UNIFORM, self.est_error_s)

    @property
    def sentence(self) -> str:
        if self.synchronised:
            return f"the system's clock is kept to UTC within {self.max_error_s:.2g} s."
        return (
            "the system's clock is not synchronised, and fixes tell no longitude: start chrony, systemd-timesyncd or "
            "linuxptp, or set the solver's clock_stddev where you know how good the clock is."
        )


def read() -> SystemClock | None:
    """The state of now; None where the system does not tell (a container may forbid it)."""
    state = _Timex()
    try:
        answer = ctypes.CDLL(None, use_errno=True).adjtimex(ctypes.byref(state))
    except (OSError, AttributeError):
        return None
    if answer < 0:
        return None
    synchronised = answer != TIME_ERROR and not state.status & STA_UNSYNC
    return SystemClock(synchronised, state.maxerror * 1e-6, state.esterror * 1e-6)


def both_clocks() -> tuple[float, float]:
    """UTC and the monotonic clock at one moment (s): read again where something came between the two."""
    for _ in range(TRIES):
        before = time.monotonic()
        utc = time.time()
        if time.monotonic() - before < QUICK_S:
            break
    return utc, before


class StepWatch:
    """Tells when the system's clock was set: moved against the clock that nobody sets, faster than any slewing.

    To be asked often, once a second or more: over a long time slewing moves a clock as far as a step does.
    clocks: gives (UTC, monotonic) in s at one moment.
    """

    def __init__(self, clocks=both_clocks):
        self._clocks = clocks
        self._lock = threading.Lock()  # one thread takes frames, another reports
        self._utc, self._monotonic = clocks()
        self._set_s = 0.0

    def step_s(self) -> float:
        """How far it was set since the last call, ahead counts positive; 0 where it was not."""
        with self._lock:
            before = self._set_s
            self._look()
            return self._set_s - before

    def set_s(self) -> float:
        """How far it was set in all since this watch began: what another thread asked meanwhile is in it."""
        with self._lock:
            self._look()
            return self._set_s

    def _look(self):
        utc, monotonic = self._clocks()
        elapsed = monotonic - self._monotonic
        moved = (utc - self._utc) - elapsed
        self._utc, self._monotonic = utc, monotonic
        if abs(moved) > STEP_S + SLEW * elapsed:
            self._set_s += moved

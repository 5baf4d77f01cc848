# SPDX-License-Identifier: Apache-2.0
"""Time stamps that contradict each other, as the stars tell: a clock that was set, a frame that was stamped wrongly.

Which one is wrong nobody knows: the contradiction is then the clock's error.
"""

import math

import numpy as np

from starpos.averaging.slip import CREEP_RAD, SIGMAS, slip_s
from starpos.earth.ellipsoid import EARTH_RADIUS_M, zenith_of
from starpos.fix.fix import Fix

# So many that agree with each other outvote one that had come before them: it was stamped wrongly, no clock was set.
OUTVOTE_ONE = 10


class ClockDoubt:
    """Takes each fix as it comes; `seconds` is what is to be believed of its time, 0 where nothing speaks against it.

    leans_otherwise: its camera stands as it stood, but its tilts do not say so: they are of another time.
    """

    def __init__(self):
        self.clear()

    def clear(self) -> None:
        """The clocks are right now, somebody says."""
        self.seconds, self.leans_otherwise = 0.0, False
        # of this pose, with what was stated of its clock, what is to be believed, and how many agree with it
        self._first: Fix | None = None
        self._first_stated_s, self._first_doubt_s, self._agree = 0.0, 0.0, 0
        self._other: Fix | None = None  # the first of those that contradict it in the same way
        self._other_agree = 0

    def add(self, fix: Fix, stated_s: float) -> None:
        """One more; stated_s: 1 sigma of its time, as its sender has it."""
        slip = None if self._first is None else slip_s(fix, self._first, self._both(stated_s))
        self.leans_otherwise = bool(slip) and _leans_otherwise(fix, self._first)
        if slip is None:  # the camera was touched: its clock is as good or bad as it was just before
            self._begin(fix, stated_s, self.seconds)
        elif slip == 0:
            self._agree += 1
            self._other, self.seconds = None, self._first_doubt_s
            if _spread(fix) < _spread(self._first):  # of a blurred one little is a contradiction
                self._first, self._first_stated_s = fix, stated_s
        else:
            again = self._other is not None and slip_s(fix, self._other, self._both(stated_s)) == 0
            self._other_agree = self._other_agree + 1 if again else 1
            self._other = self._other if again else fix
            self.seconds = max(self._first_doubt_s, slip)
            if self._agree == 1 and self._other_agree == OUTVOTE_ONE:
                self._begin(fix, stated_s, self._first_doubt_s)
                self._agree = OUTVOTE_ONE

    def _begin(self, fix: Fix, stated_s: float, doubt_s: float) -> None:
        self._first, self._first_stated_s, self._first_doubt_s, self._agree = fix, stated_s, doubt_s, 1
        self._other, self.seconds = None, doubt_s

    def _both(self, stated_s: float) -> float:
        """1 sigma of how a stamp and the first one's differ."""
        return math.hypot(stated_s, self._first_stated_s)


def _spread(fix: Fix) -> float:
    return float(np.trace(fix.camera_covariance))


def _leans_otherwise(fix: Fix, first: Fix) -> bool:
    """Whether the vertical of two fixes of one pose, as the camera sees it, differs by more than their tilts' errors."""
    up, before = (f.camera_to_itrs.T @ zenith_of(f.latitude, f.longitude) for f in (fix, first))
    own_m2 = sum(np.trace(t.covariance[:2, :2]) for f in (fix, first) for t in f.terms if not t.common)
    return bool(np.linalg.norm(up - before) > SIGMAS * np.sqrt(own_m2) / EARTH_RADIUS_M + CREEP_RAD)

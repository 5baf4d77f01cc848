# SPDX-License-Identifier: Apache-2.0
"""Doubt about time stamps that contradict the stars: a clock was set, or a frame was stamped wrongly.

It is unknown which stamp is wrong, so the size of the contradiction is taken as the error of the clock.
"""

import math

import numpy as np

from starpos.averaging.slip import CREEP_RAD, SIGMAS, slip_s
from starpos.earth.ellipsoid import EARTH_RADIUS_M, zenith_of
from starpos.fix.fix import Fix

# Number of agreeing frames that outvote a single earlier one: that one was stamped wrongly, and no clock was set.
OUTVOTE_ONE = 10


class ClockDoubt:
    """Judges the time of each fix; `seconds` is the error to assume for it, 0 if nothing contradicts its stamp.

    leans_otherwise: the camera stands as before, but the tilts differ, so the tilts are of another time.
    """

    def __init__(self) -> None:
        self.clear()

    def clear(self) -> None:
        """Forget all doubt, because the user confirms the clocks."""
        self.seconds, self.leans_otherwise = 0.0, False
        # The first fix of this pose, the stated and the assumed error of its clock, and how many fixes agree with it.
        self._first: Fix | None = None
        self._first_stated_s, self._first_doubt_s, self._agree = 0.0, 0.0, 0
        # The first of the fixes that contradict it in the same way.
        self._other: Fix | None = None
        self._other_agree = 0

    def add(self, fix: Fix, stated_s: float) -> None:
        """Take a fix; stated_s: standard deviation of its time, as its sender states it."""
        first = self._first
        slip = None if first is None else slip_s(fix, first, self._both(stated_s))
        self.leans_otherwise = False
        if first is None or slip is None:
            # The camera was touched; its clock is as good or bad as just before.
            self._begin(fix, stated_s, self.seconds)
        elif slip == 0:
            self._agree += 1
            self._other, self.seconds = None, self._first_doubt_s
            # Compare with the sharpest frame: a blurred one contradicts little.
            if _spread(fix) < _spread(first):
                self._first, self._first_stated_s = fix, stated_s
        else:
            self.leans_otherwise = _leans_otherwise(fix, first)
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
        """Standard deviation of the difference between a stamp and the first fix's stamp."""
        return math.hypot(stated_s, self._first_stated_s)


def _spread(fix: Fix) -> float:
    return float(np.trace(fix.camera_covariance))


def _leans_otherwise(fix: Fix, first: Fix) -> bool:
    """Whether the verticals of two fixes of one pose, seen from the camera, differ by more than the tilts' errors."""
    up, before = (f.camera_to_itrs.T @ zenith_of(f.latitude, f.longitude) for f in (fix, first))
    own_m2 = sum(np.trace(t.covariance[:2, :2]) for f in (fix, first) for t in f.terms if not t.common)
    return bool(np.linalg.norm(up - before) > SIGMAS * np.sqrt(own_m2) / EARTH_RADIUS_M + CREEP_RAD)

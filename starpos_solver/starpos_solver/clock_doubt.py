# SPDX-License-Identifier: Apache-2.0
"""Time stamps that contradict each other, as the stars tell: a clock that was set, a frame that was stamped wrongly.

A camera at rest sees the sky turn about the Earth's axis by its stamps; if by them it has turned about that axis itself,
as no hand turns it, one of the stamps is wrong.  Which one, nobody knows: the contradiction is then the clock's error.
"""

import numpy as np

from starpos.average import HIGHEST_LATITUDE, POSE_RAD, POSE_SIGMA
from starpos.earth import ROTATION_RAD_S
from starpos.fix import Fix

# So many that agree with each other outvote one that had come before them: it was stamped wrongly, no clock was set.
OUTVOTE_ONE = 10


class ClockDoubt:
    """Takes each fix as it comes; `seconds` is what is to be believed of its time, 0 where nothing speaks against it."""

    def __init__(self):
        self.clear()

    def clear(self) -> None:
        """The clocks are right now, somebody says."""
        self.seconds = 0.0
        # of this pose, with what was stated of its clock, what is to be believed, and how many agree with it
        self._first: Fix | None = None
        self._first_stated_s, self._first_doubt_s, self._agree = 0.0, 0.0, 0
        self._other: Fix | None = None  # the first of those that contradict it in the same way
        self._other_agree = 0

    def add(self, fix: Fix, stated_s: float) -> None:
        """One more; stated_s: 1 sigma of its time, as its sender has it."""
        slip_s = None if self._first is None else self._slip_s(fix, self._first, stated_s)
        if slip_s is None:  # the camera was touched: its clock is as good or bad as it was just before
            self._begin(fix, stated_s, self.seconds)
        elif slip_s == 0:
            self._agree += 1
            self._other, self.seconds = None, self._first_doubt_s
            if fix.attitude_sigma < self._first.attitude_sigma:  # of a blurred one little is a contradiction
                self._first, self._first_stated_s = fix, stated_s
        else:
            again = self._other is not None and self._slip_s(fix, self._other, stated_s) == 0
            self._other_agree = self._other_agree + 1 if again else 1
            self._other = self._other if again else fix
            self.seconds = max(self._first_doubt_s, slip_s)
            if self._agree == 1 and self._other_agree == OUTVOTE_ONE:
                self._begin(fix, stated_s, self._first_doubt_s)
                self._agree = OUTVOTE_ONE

    def _begin(self, fix: Fix, stated_s: float, doubt_s: float) -> None:
        self._first, self._first_stated_s, self._first_doubt_s, self._agree = fix, stated_s, doubt_s, 1
        self._other, self.seconds = None, doubt_s

    def _slip_s(self, fix: Fix, first: Fix, stated_s: float) -> float | None:
        """By how much their stamps contradict each other; 0 within what is allowed, None of a camera that was touched."""
        turned = fix.camera_to_itrs @ first.camera_to_itrs.T
        allowed = max(POSE_RAD, POSE_SIGMA * float(np.hypot(fix.attitude_sigma, first.attitude_sigma)))
        pole_moved = np.hypot(turned[0, 2], turned[1, 2]) > allowed or turned[2, 2] < 0
        at_pole = abs(fix.latitude) > HIGHEST_LATITUDE  # there any turn on the spot is one about that axis
        if pole_moved or at_pole:
            return None
        slip = abs(float(np.arctan2(turned[1, 0], turned[0, 0])))
        stated = POSE_SIGMA * float(np.hypot(stated_s, self._first_stated_s)) * ROTATION_RAD_S
        return 0.0 if slip <= allowed + stated else slip / ROTATION_RAD_S

# SPDX-License-Identifier: Apache-2.0
"""The fixes of an instrument at rest, taken together: their average, and whether a clock was set or the level changed."""

import math
from enum import Enum, auto

import numpy as np

from starpos.averaging.average import MOVED_FIXES, Average, Averager
from starpos.averaging.poses import CREEP_RAD, SLIP_SIGMAS, slip_s
from starpos.earth.ellipsoid import EARTH_RADIUS_M, curvature_radii_m, enu_axes, zenith_of
from starpos.fix.fix import Fix
from starpos.fix.terms import Origin
from starpos.session.driver import Diagnosis, Level
from starpos.units import ARCSEC

# With a larger A3 error the quadratic term, which a linear filter ignores, exceeds 2 arcsec.
WIDE_RAD = 600 * ARCSEC
# A fix this far from the place of a turn is at another place. A false alarm only costs precision.
ELSEWHERE_SIGMA = 3.0
# Number of fixes for which the diagnostics report that the instrument has moved.
JUST_MOVED = 10


class News(Enum):
    """What a new fix did to the average."""

    USED = auto()
    LEFT_OUT = auto()
    MOVED = auto()


class Averaging:
    """An Averager that starts again when it must, or the place of a turn on the spot while the instrument stays there.

    Frames after a turn are solved with the A3 that the turn found. So they add nothing to the place of the turn; they
    only show whether the instrument is still there.
    """

    def __init__(self) -> None:
        self.begin_anew()

    def begin_anew(self) -> None:
        """Start again, because the instrument, the air, the clock or the place has changed."""
        self._averager = Averager()
        self._turned: Average | None = None
        # The first fix of the present pose.
        self._pose: Fix | None = None
        self._news = News.USED
        self._moved = 0

    def turned_on_the_spot(self, place: Average) -> None:
        """Take the place that a turn has found; later fixes are solved with its A3."""
        self.begin_anew()
        self._turned = place

    @property
    def place(self) -> Average | None:
        """The average place; None before the first fix."""
        elsewhere = self._turned is None or self._news is News.LEFT_OUT
        return self._averager.average if elsewhere else self._turned

    @property
    def began_unix_s(self) -> float:
        """Time of the first fix of this place; -inf before there is one."""
        place = self._averager.average
        return -math.inf if place is None else place.began_unix_s

    def include(self, fix: Fix) -> News:
        """Take a fix that is later than all before."""
        if self._pose is None or slip_s(fix.camera, self._pose.camera, fix.latitude) != 0:
            self._pose = fix
            if self._turned is not None or _is_wide(fix):
                self._averager = Averager()
        before = self._averager.average
        self._averager.include(fix)
        after = self._averager.average
        assert after is not None
        self._news = self._judged(before, after)
        self._moved += self._news is News.MOVED
        return self._news

    def _judged(self, before: Average | None, after: Average) -> News:
        if self._turned is not None:
            if _sigmas_apart(after, self._turned) <= ELSEWHERE_SIGMA:
                return News.USED
            if after.frames < MOVED_FIXES:
                return News.LEFT_OUT
            self._turned = None
            return News.MOVED
        if before is None or after.moved == before.moved:
            return News.LEFT_OUT if before and after.left_out > before.left_out else News.USED
        return News.MOVED

    def report(self) -> Diagnosis:
        """Make the diagnostic `Average`."""
        place = self.place
        if place is None:
            return Diagnosis(Level.OK, "no fix yet", {"moved": self._moved})
        east, north, _ = place.covariance.diagonal() ** 0.5
        here = self._averager.average or place
        values: dict[str, object] = {
            "frames": place.frames,
            "poses": place.poses,
            "left out": here.left_out,
            "moved": self._moved,
        }
        values |= {"sigma east (m)": float(east), "sigma north (m)": float(north)}
        if self._news is News.LEFT_OUT:
            far = "the newest fix lies further from the average than its error allows: it is left out"
            return Diagnosis(Level.WARN, far, values)
        if self._moved and here.frames <= JUST_MOVED:
            return Diagnosis(Level.WARN, "the instrument has moved: the average begins anew", values)
        return Diagnosis(
            Level.OK, "of the turn on the spot" if self._turned else "of all frames here", values
        )


def _is_wide(fix: Fix) -> bool:
    """Whether A3's error is too large for a linear filter to separate it from the place."""
    of_a3 = [t.covariance[:2, :2] for t in fix.terms if t.origin is Origin.A3]
    # what GNSS taught of A3 is a term of its own, and linear
    calibration = sum(of_a3, np.zeros((2, 2)))
    return bool(np.linalg.eigvalsh(calibration)[-1] > (WIDE_RAD * EARTH_RADIUS_M) ** 2)


def _sigmas_apart(a: Average, b: Average) -> float:
    radii = np.array(curvature_radii_m(b.latitude))
    apart = enu_axes(b.latitude, b.longitude)[:2] @ zenith_of(a.latitude, a.longitude) * radii
    return float(np.sqrt(apart @ np.linalg.solve((a.covariance + b.covariance)[:2, :2], apart)))


# Number of agreeing frames that outvote a single earlier one: that one was wrong, and no clock or level was set.
OUTVOTE_ONE = 10


class ClockDoubt:
    """Judges the time of each fix; `seconds` is the error to assume for it, 0 if nothing contradicts its stamp.

    It is unknown which of two contradicting stamps is wrong, so the contradiction is taken as the error of the clock.
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

    def judge(self, fix: Fix, stated_s: float) -> None:
        """Take a fix; stated_s: standard deviation of its time, as its sender states it."""
        first = self._first
        slip = None if first is None else slip_s(fix.camera, first.camera, fix.latitude, self._both(stated_s))
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
            other, both_s = self._other, self._both(stated_s)
            again = other is not None and slip_s(fix.camera, other.camera, fix.latitude, both_s) == 0
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


# A contradiction by this number of fixes in a row is no passing fault.
LASTING = 2


class LevelDoubt:
    """Judges the level while the stars show that the camera stands still: was it set to zero, or knocked?

    Which of two levels is right is unknown: the first of a pose counts, unless only one fix had it. After a lasting
    contradiction the level is not believed in later poses either, until the user confirms it.
    """

    def __init__(self) -> None:
        self.clear()

    def clear(self) -> None:
        """Forget all doubt, because the user confirms the level or A3 is new."""
        # the first fix of this pose, and how many agree with it
        self._first: Fix | None = None
        self._agree = 0
        # the last of the fixes that contradict it in the same way, and how many there are
        self._other: Fix | None = None
        self._others = 0

    def begin_anew(self) -> None:
        """Take the next fix as a pose's first, as the air is another; a lasting doubt stays."""
        if self._others < LASTING:
            self.clear()

    def contradicts(self, fix: Fix, stated_s: float) -> bool:
        """Take a fix; whether its level contradicts the one that counts.  stated_s: 1 sigma of its time."""
        first = self._first
        if first is None or slip_s(fix.camera, first.camera, fix.latitude, math.sqrt(2) * stated_s) != 0:
            if self._others < LASTING:
                self._begin(fix, 1)
        elif _at_one_place(fix, first):
            self._agree, self._others = self._agree + 1, 0
        else:
            again = self._others > 0 and self._other is not None and _at_one_place(fix, self._other)
            self._other, self._others = fix, self._others + 1 if again else 1
            if self._agree == 1 and self._others == OUTVOTE_ONE:
                self._begin(fix, OUTVOTE_ONE)
        return self._others > 0

    def _begin(self, fix: Fix, agree: int) -> None:
        self._first, self._agree, self._others = fix, agree, 0


def _at_one_place(fix: Fix, before: Fix) -> bool:
    """Whether the claimed errors of two fixes of one pose, and the mount's creep, explain how far they are apart."""
    zeniths = (zenith_of(f.latitude, f.longitude) for f in (fix, before))
    apart_m = EARTH_RADIUS_M * np.linalg.norm(np.subtract(*zeniths))
    claimed_m = np.sqrt(sum(np.trace(f.covariance[:2, :2]) for f in (fix, before)))
    return bool(apart_m <= SLIP_SIGMAS * claimed_m + CREEP_RAD * EARTH_RADIUS_M)


def _spread(fix: Fix) -> float:
    return float(np.trace(fix.camera.covariance))


def _leans_otherwise(fix: Fix, first: Fix) -> bool:
    """Whether the verticals of two fixes of one pose, seen from the camera, differ by more than the tilts' errors."""
    up, before = (f.camera.rotation.T @ zenith_of(f.latitude, f.longitude) for f in (fix, first))
    own_m2 = sum(np.trace(t.covariance[:2, :2]) for f in (fix, first) for t in f.terms if not t.common)
    return bool(np.linalg.norm(up - before) > SLIP_SIGMAS * np.sqrt(own_m2) / EARTH_RADIUS_M + CREEP_RAD)

# SPDX-License-Identifier: Apache-2.0
"""The place of the standing instrument from all its frames, for `fix_averaged`."""

from enum import Enum, auto

import numpy as np

from starpos.averaging.average import MOVED_FIXES, Average, Averager
from starpos.averaging.slip import slip_s
from starpos.earth.ellipsoid import EARTH_RADIUS_M, curvature_radii_m
from starpos.fix.fix import Fix
from starpos.units import ARCSEC
from starpos_common.diagnostics import Diagnosis, Level

WIDE_RAD = 600 * ARCSEC  # its square, which a linear filter does not know of, is 2 arcsec
ELSEWHERE_SIGMA = 3.0  # from the place of a turn; wrongly taken for another place it only costs precision
JUST_MOVED = 10  # fixes; the diagnostics say so as long


class News(Enum):
    """What a fix was taken for."""

    USED = auto()
    LEFT_OUT = auto()
    MOVED = auto()


class Averaging:
    """An Averager that begins anew where it must; or the place of a turn on the spot, as long as the instrument stays.

    Later frames hold the A3 that the turn has found: they tell no more of its place, but whether they are of it.
    """

    def __init__(self):
        self.begin_anew()

    def begin_anew(self) -> None:
        """The instrument, the air or the clock are others now, or the place is."""
        self._averager = Averager()
        self._turned: Average | None = None
        self._pose: Fix | None = None  # its first
        self._elsewhere = False  # it seems so, against the place of the turn
        self._news = News.USED
        self._moved = 0

    def turned_on_the_spot(self, place: Average) -> None:
        """The place that a turn has told; fixes from now on are solved with its A3."""
        self.begin_anew()
        self._turned = place

    @property
    def place(self) -> Average | None:
        """None before the first fix."""
        return self._averager.average if self._turned is None or self._elsewhere else self._turned

    @property
    def began_unix_s(self) -> float:
        """The first fix of this place."""
        return self._averager.average.began_unix_s

    def add(self, fix: Fix) -> News:
        """One more fix, later than all before."""
        if self._pose is None or slip_s(fix, self._pose) != 0:
            self._pose = fix
            if self._turned is not None or _is_wide(fix):
                self._averager = Averager()
        before = self._averager.average
        self._averager.add(fix)
        self._news = self._judged(before, self._averager.average)
        self._moved += self._news is News.MOVED
        return self._news

    def _judged(self, before: Average | None, after: Average) -> News:
        if self._turned is not None:
            self._elsewhere = _sigmas_apart(after, self._turned) > ELSEWHERE_SIGMA
            if self._elsewhere and after.frames >= MOVED_FIXES:
                self._turned = None
                return News.MOVED
            return News.LEFT_OUT if self._elsewhere else News.USED
        if before is None or after.moved == before.moved:
            return News.LEFT_OUT if before and after.left_out > before.left_out else News.USED
        return News.MOVED

    def report(self) -> Diagnosis:
        """For /diagnostics."""
        place = self.place
        if place is None:
            return Diagnosis(Level.OK, "no fix yet", {"moved": self._moved})
        east, north, _ = place.covariance.diagonal() ** 0.5
        here = self._averager.average or place
        values = {
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
    """Whether A3 may be so wrong that a linear filter does not tell its error from the place, heading by heading."""
    calibration = sum(t.covariance[:2, :2] for t in fix.terms if t.name == "calibration")
    return bool(np.linalg.eigvalsh(calibration)[-1] > (WIDE_RAD * EARTH_RADIUS_M) ** 2)


def _sigmas_apart(a: Average, b: Average) -> float:
    prime, meridian = curvature_radii_m(b.latitude)
    east = (a.longitude - b.longitude + np.pi) % (2 * np.pi) - np.pi
    apart = np.array([east * prime * np.cos(b.latitude), (a.latitude - b.latitude) * meridian])
    return float(np.sqrt(apart @ np.linalg.solve((a.covariance + b.covariance)[:2, :2], apart)))

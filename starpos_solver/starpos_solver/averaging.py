# SPDX-License-Identifier: Apache-2.0
"""The place of the standing instrument from all its frames, for `fix_averaged`."""

from collections.abc import Sequence
from enum import Enum, auto

from starpos.average import Average, Averager
from starpos.fix import Fix
from starpos_common.diagnostics import Level
from starpos_common.diagnostics import Status as Report

JUST_MOVED = 10  # fixes; the diagnostics say so as long


class News(Enum):
    """What a fix was taken for."""

    USED = auto()
    LEFT_OUT = auto()
    MOVED = auto()


class Averaging:
    """An Averager that begins anew where it must; or the place of a turn on the spot, as long as the instrument stays.

    Later frames hold the A3 that the turn has found, so they tell nothing more of the place that it has told already.
    """

    def __init__(self):
        self.begin_anew()

    def begin_anew(self) -> None:
        """The instrument, the air or the clock are others now, or the place is."""
        self._averager = Averager()
        self._turned: Average | None = None
        self._news = News.USED
        self._moved = 0

    def turned_on_the_spot(self, place: Average, fixes: Sequence[Fix]) -> None:
        """`place` is what a turn gave; its fixes, solved again with the A3 found, tell when later ones are elsewhere."""
        self.begin_anew()
        for fix in sorted(fixes, key=lambda f: f.utc_unix_s):
            self._averager.add(fix)
        self._turned = place

    @property
    def place(self) -> Average | None:
        """None before the first fix."""
        return self._turned or self._averager.average

    @property
    def began_unix_s(self) -> float:
        """The first fix of this place."""
        return self._averager.average.began_unix_s

    def add(self, fix: Fix) -> News:
        """One more fix, later than all before."""
        before = self._averager.average
        self._averager.add(fix)
        after = self._averager.average
        if before is None or after.moved == before.moved:
            left_out = before is not None and after.left_out > before.left_out
            self._news = News.LEFT_OUT if left_out else News.USED
            return self._news
        if self._turned is not None:  # the averager holds the fixes of the turn, which A3 is of
            self._averager, self._turned = Averager(), None
            self._averager.add(fix)
        self._moved += 1
        self._news = News.MOVED
        return self._news

    def report(self) -> Report:
        """For /diagnostics."""
        place = self.place
        if place is None:
            return Report(Level.OK, "no fix yet", {"moved": self._moved})
        east, north, _ = place.covariance.diagonal() ** 0.5
        here = self._averager.average
        values = {
            "frames": place.frames,
            "poses": place.poses,
            "left out": here.left_out,
            "moved": self._moved,
        }
        values |= {"sigma east (m)": float(east), "sigma north (m)": float(north)}
        if self._news is News.LEFT_OUT:
            far = "the newest fix lies further from the average than its error allows: it is left out"
            return Report(Level.WARN, far, values)
        if self._moved and here.frames <= JUST_MOVED:
            return Report(Level.WARN, "the instrument has moved: the average begins anew", values)
        return Report(Level.OK, "of the turn on the spot" if self._turned else "of all frames here", values)

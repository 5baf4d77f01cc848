# SPDX-License-Identifier: Apache-2.0
"""Many frames of one place made into one fix, as they come in or all at once: both go through the same recursion.

A fix that lies far from the others (a tilt misread, a time stamp off) is left out; a robot that moved on begins anew.
Which of the two it is, the stars tell: a camera that has not turned against the Earth has not moved.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from starpos.averaging.filter import PlaceFilter
from starpos.averaging.slip import slip_s
from starpos.errors import FixError
from starpos.fix.budget import ErrorTerm
from starpos.fix.fix import Fix

GATE_SIGMA = 6.0  # further off a fix is not of this place, or wrong
MOVED_FIXES, MOVED_SIGMA = 3, 4.5  # so many fixes of a turned camera, so far off, are another place
RIVAL_FIXES = 10  # a rival is replaced by a newer one no sooner


@dataclass(frozen=True, kw_only=True)
class Average:
    """The combined position and the heading of the last pose (rad), with the budget of its errors.

    The heading is NaN where no fix of that pose was believed yet.
    frames: how many it is of, in how many poses; left_out: how many since its beginning were not believed.
    began_unix_s, utc_unix_s: of its first fix, and the mean of all.  moved: how many averages of other places there were
    before it.
    """

    utc_unix_s: float
    latitude: float
    longitude: float
    heading: float
    terms: tuple[ErrorTerm, ...]
    frames: int
    poses: int
    left_out: int
    began_unix_s: float
    moved: int

    @property
    def covariance(self) -> np.ndarray:
        """(3, 3) of east m, north m, heading rad; NaN in the heading's row and column where there is none."""
        covariance = sum(t.covariance for t in self.terms)[:3, :3].copy()
        if np.isnan(self.heading):
            covariance[2] = covariance[:, 2] = np.nan
        return covariance


def average(fixes: Sequence[Fix]) -> Average:
    """The average of fixes, of the last place in time if there are several; the same frame twice counts once.

    Raises FixError where there is none, or where as many were left out as were used, so that it cannot be told which are
    right.
    """
    if not fixes:
        raise FixError("there is no fix to average: none of the frames has one")
    averager = Averager()
    for f in sorted({(f.utc_unix_s, f.latitude, f.longitude): f for f in fixes}.values(), key=_time):
        averager.add(f)
    whole = averager.average
    if whole.left_out >= whole.frames:
        raise FixError(
            f"of {whole.frames + whole.left_out} frames {whole.left_out} lie further from the others than their errors "
            "allow, too many to say which are right: they are not of one place, the mount or the clock slipped, or the "
            "instrument turned and its A3 is not what it was said to be (--self-calibrate finds it)"
        )
    return whole


def _time(f: Fix) -> float:
    return f.utc_unix_s


@dataclass(frozen=True, kw_only=True)
class _Track:
    """An average in the making; in_pose: its frames since the camera was last touched."""

    running: PlaceFilter
    frames: int = 0
    poses: int = 0
    in_pose: int = 0
    mean_unix_s: float = 0.0
    began_unix_s: float = float("nan")

    @classmethod
    def before(cls, f: Fix) -> "_Track":
        return cls(running=PlaceFilter.before(f), began_unix_s=f.utc_unix_s)

    def rival(self, f: Fix) -> "_Track":
        """A new one that knows of this one's errors, not of its place."""
        return _Track(running=self.running.elsewhere(f), began_unix_s=f.utc_unix_s)

    def touched(self) -> "_Track":
        return replace(self, running=self.running.heading_unknown(), in_pose=0)

    def add(self, f: Fix, pose: Fix) -> "_Track | None":
        """With one more fix of a pose; None where it is too far off."""
        running, sigmas = self.running.add(f, pose)
        if sigmas > GATE_SIGMA or not running.straight_from(self.running):
            return None
        n = self.frames + 1
        mean = self.mean_unix_s + (f.utc_unix_s - self.mean_unix_s) / n
        poses = self.poses + (self.in_pose == 0)
        return replace(
            self, running=running, frames=n, poses=poses, in_pose=self.in_pose + 1, mean_unix_s=mean
        )


class Averager:
    """The recursion: `add` fixes in order of time, `average` is what they say.  Its memory does not grow."""

    def __init__(self):
        self._track: _Track | None = None
        self._rival: _Track | None = (
            None  # of the fixes since the camera was touched, or since one was not believed
        )
        self._rival_turned = False  # whether the camera was touched when the rival began
        self._disbelieved = 0  # fixes in a row
        self._left_out = self._moved = 0
        self._last: Fix | None = None
        self._pose: Fix | None = None  # the first of this pose

    @property
    def average(self) -> Average | None:
        """None before the first fix."""
        t = self._track
        if t is None:
            return None
        latitude, longitude, heading = t.running.place
        return Average(
            utc_unix_s=t.mean_unix_s,
            latitude=latitude,
            longitude=longitude,
            heading=heading,
            terms=t.running.terms(self._last.terms),
            frames=t.frames,
            poses=t.poses,
            left_out=self._left_out,
            began_unix_s=t.began_unix_s,
            moved=self._moved,
        )

    def add(self, f: Fix) -> None:
        """One more fix, later than those before."""
        if self._track is None:
            self._track, self._last, self._pose = _Track.before(f).add(f, f), f, f
            return
        slip = slip_s(f, self._pose)
        if slip is None:
            self._turn(f)
        self._last = f
        before, with_it = self._track, None if slip else self._track.add(f, self._pose)
        rival = self._rival.add(f, self._pose) if self._rival else None
        if with_it is not None:
            self._track, self._disbelieved = with_it, 0
            if self._rival is not None and rival is None:  # it began with a wrong one
                rival = before.rival(f).add(f, self._pose) if self._rival_turned else None
            self._rival = rival
            if rival is not None and self._is_elsewhere(rival):
                self._move(f)
            return
        self._left_out += 1
        self._disbelieved += 1
        if rival is None:
            self._rival_turned &= self._rival is not None
            rival, self._disbelieved = before.rival(f).add(f, self._pose), 1
        self._rival = rival
        # of a camera nobody touched it takes the majority to say that the average is wrong
        if self._disbelieved >= MOVED_FIXES if self._rival_turned else rival.frames > self._track.in_pose:
            self._move(f)

    def _turn(self, f: Fix) -> None:
        """The camera was touched: its heading is another, and its place may be."""
        self._pose, self._track = f, self._track.touched()
        if self._rival is not None and (self._disbelieved or self._rival.frames < RIVAL_FIXES):
            self._rival, self._rival_turned = self._rival.touched(), True
            return
        self._rival, self._rival_turned = self._track.rival(f), True

    def _is_elsewhere(self, rival: _Track) -> bool:
        return (
            self._rival_turned
            and rival.frames >= MOVED_FIXES
            and self._track.frames > rival.frames
            and self._track.running.sigmas_apart(rival.running) > MOVED_SIGMA
        )

    def _move(self, f: Fix) -> None:
        """The rival is right, with its last fix."""
        if self._rival_turned:
            self._moved += 1
            self._left_out = 0
        else:
            self._left_out += self._track.in_pose - self._rival.frames
        self._track, self._rival, self._disbelieved, self._pose = self._rival, None, 0, f

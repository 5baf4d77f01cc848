# SPDX-License-Identifier: Apache-2.0
"""The average of many fixes of one place, one after the other or all at once, and what it claims for their scatter."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import erfa
import numpy as np

from starpos._numeric.roots import symmetric_root
from starpos.averaging.filter import PlaceFilter, Plane
from starpos.averaging.poses import poses_of, slip_s
from starpos.averaging.scatter import MAX_ROWS, Frames, Scatter, scatter_of
from starpos.earth.ellipsoid import EARTH_RADIUS_M, zenith_of
from starpos.earth.orientation import ROTATION_RAD_S
from starpos.errors import FixError
from starpos.fix.fix import Fix, PlaceFix, zenith_variance
from starpos.fix.terms import EACH_POSE, ErrorTerm
from starpos.frozen import at_once
from starpos.rotation import half_turn

# sigma of a place in rad before anything is known of it
ANYWHERE_RAD = np.pi
# number of remembered fixes at which they are averaged two by two
MAX_REMEMBERED = 2 * MAX_ROWS
# one more fix changes little among many: the scatter is computed again after an increase by this share
NEWS = 0.3


@at_once
@dataclass(frozen=True, kw_only=True)
class Remembered:
    """A fix, or the mean of some that follow each other in a pose.

    attitude (3, 3): ITRS into C.  up (3,): in C.
    place (2,): east, north in m in the plane.  to_rad (2, 2): m to the inclinometer's axes in rad.
    shared (2, n): m for 1 sigma of each error that all fixes share.
    sigma (rad): of its own errors.  pose_sigma (rad): stated, of an error of the pose.
    """

    utc_unix_s: float
    pose: int
    fixes: int
    attitude: np.ndarray
    up: np.ndarray
    place: np.ndarray
    to_rad: np.ndarray
    shared: np.ndarray
    sigma: float
    pose_sigma: float

    @classmethod
    def of(cls, f: Fix, first: Fix, pose: int, plane: Plane) -> "Remembered":
        """The part of a fix to remember; its pose began with `first`."""
        own = [t for t in f.terms if not t.common and t.shared != EACH_POSE]
        new = [t for t in f.terms if t.shared == EACH_POSE]
        turn, first_turn = plane.turn(f)[:2], plane.turn(first)[:2]
        factors = [
            math.sqrt(t.variance)
            * (first_turn @ like.factor[:3] if t.constant_within_pose else turn @ t.factor[:3])
            for t, like in zip(f.terms, first.terms, strict=True)
            if t.common
        ]
        return cls(
            utc_unix_s=f.utc_unix_s,
            pose=pose,
            fixes=1,
            attitude=f.camera.rotation.T,
            up=f.camera.rotation.T @ zenith_of(f.latitude, f.longitude),
            place=plane.coordinates(f)[:2],
            to_rad=np.linalg.inv(turn @ f.levelling[:3]),
            shared=np.hstack(factors),
            sigma=math.sqrt(zenith_variance(own)),
            pose_sigma=math.sqrt(zenith_variance(new)),
        )

    def with_next(self, other: "Remembered") -> "Remembered":
        """The mean of this and the next one of its pose."""
        n = self.fixes + other.fixes
        a, b = self.fixes / n, other.fixes / n
        return replace(
            self,
            utc_unix_s=a * self.utc_unix_s + b * other.utc_unix_s,
            fixes=n,
            place=a * self.place + b * other.place,
            sigma=float(np.hypot(a * self.sigma, b * other.sigma)),
        )


@at_once
@dataclass(frozen=True)
class Claim:
    """The remembered parts of the fixes of a place, and the result when they were last looked at.

    looked: number of fixes then.  frame_sigma (rad): evident error of a fix in addition to its stated errors.
    beyond (2, 2): covariance in m2 of east, north beyond what the filter states.
    """

    seen: tuple[Remembered, ...] = ()
    fixes: int = 0
    looked: int = 0
    frame_sigma: float = 0.0
    beyond: np.ndarray | None = None

    def with_fix(self, seen: Remembered, east_north_m: np.ndarray) -> "Claim":
        """The claim with one more fix, after which the filter has the place at east_north_m (2,)."""
        kept = (*self.seen, seen)
        more = replace(
            self, seen=_shortened(kept) if len(kept) > MAX_REMEMBERED else kept, fixes=self.fixes + 1
        )
        return more if more.fixes < (1 + NEWS) * self.looked else more.looked_at(east_north_m)

    def looked_at(self, east_north_m: np.ndarray) -> "Claim":
        """The claim after a new look at all that is remembered."""
        scatter = self._scatter()
        off = scatter.moved[:2] - (east_north_m - self._middle) / EARTH_RADIUS_M
        beyond = scatter.covariance[:2, :2] + np.outer(off, off) - scatter.stated[:2, :2]
        values, vectors = np.linalg.eigh(beyond * EARTH_RADIUS_M**2)
        pose_sigma = self.seen[-1].pose_sigma
        return replace(
            self,
            looked=self.fixes,
            frame_sigma=float(np.sqrt(max(scatter.frame_sigma**2 - pose_sigma**2, 0.0)))
            if scatter.evident
            else 0.0,
            beyond=(vectors * np.maximum(values, 0.0)) @ vectors.T,
        )

    def term(self, name: str, last: Fix) -> ErrorTerm:
        """What is to be claimed beyond the filter's budget, with rows east m, north m, heading rad as of the last fix."""
        root = np.zeros((2, 2)) if self.beyond is None else symmetric_root(self.beyond)
        heading = last.levelling[2:3] @ np.linalg.inv(last.levelling[:2]) @ root
        return ErrorTerm(name, np.vstack([root, heading]))

    @property
    def _middle(self) -> np.ndarray:
        return np.median([s.place for s in self.seen], axis=0)

    def _scatter(self) -> Scatter:
        """The scatter; its first two parameters are east and north in rad, against the middle of what is remembered."""
        to_rad = np.array([s.to_rad for s in self.seen])
        off = np.array([s.place for s in self.seen]) - self._middle
        place = np.broadcast_to(np.eye(2) * EARTH_RADIUS_M, (len(off), 2, 2))
        columns = -np.concatenate([place, [s.shared for s in self.seen]], 2)
        n = columns.shape[2]
        return scatter_of(
            Frames(
                utc_unix_s=np.array([s.utc_unix_s for s in self.seen]),
                pose=np.unique([s.pose for s in self.seen], return_inverse=True)[1],
                attitude=np.array([s.attitude for s in self.seen]),
                up=np.array([s.up for s in self.seen]),
                residual=np.einsum("kij,kj->ki", to_rad, off),
                design=np.einsum("kij,kjn->kin", to_rad, columns),
                sigma=np.array([s.sigma for s in self.seen]),
                pose_sigma=float(np.median([s.pose_sigma for s in self.seen])),
                prior_sigma=np.append([ANYWHERE_RAD] * 2, np.ones(n - 2)),
                response=np.zeros(n, bool),
                zero_free=False,
            )
        )


def _shortened(seen: tuple[Remembered, ...]) -> tuple[Remembered, ...]:
    """Neighbours of a pose averaged two by two; where poses have one each, only the later half."""
    short: list[Remembered] = []
    for s in seen:
        if short and short[-1].pose == s.pose and short[-1].fixes <= s.fixes:
            short[-1] = short[-1].with_next(s)
        else:
            short.append(s)
    return tuple(short[-MAX_ROWS:] if len(short) > MAX_REMEMBERED - MAX_ROWS // 2 else short)


# the term of what fixes scatter beyond their budgets
SCATTER = "scatter"
# a fix further off than this is wrong, or of another place
GATE_SIGMA = 6.0
# minimum number and distance of fixes of a turned camera that belong to another place
MOVED_FIXES, MOVED_SIGMA = 3, 4.5
# minimum number of steps from pose to pose that show their scatter, share of the smaller ones that are used, and
# maximum error of an inclinometer
MIN_STEPS, SMALLER, MAX_POSE_RAD = 6, 1 / 3, np.radians(0.25)
# if fewer than this share of the fixes agree, they do not describe one place
MAX_OF_ALL = 2 / 3
# a rival with fewer fixes is kept when the camera is touched again
RIVAL_FIXES = 10


@at_once
@dataclass(frozen=True, kw_only=True)
class Average(PlaceFix):
    """The averaged place, and the heading of the last pose, with the budget of their errors.

    A pose lasts until somebody touches the camera.  The heading is NaN while no fix of the last pose has been accepted.

    Attributes
    ----------
    frames, poses : number of accepted fixes and of their poses
    left_out : number of fixes that were not accepted
    began_unix_s : time of the first fix
    utc_unix_s : mean of the times of all
    moved : number of earlier averages, of other places

    Examples
    --------
    >>> starpos.open_night("night", instrument="instrument.yaml").solve().combined.frames
    5
    """

    frames: int
    poses: int
    left_out: int
    began_unix_s: float
    moved: int

    def __repr__(self) -> str:
        return f"<Average of {self.frames} frames: {self.in_degrees}>"


def average(fixes: Sequence[Fix]) -> Average:
    """The average of fixes in any order, of the last place in time if there are several; a frame counts once.

    Parameters
    ----------
    fixes : of frames, each with its budget of errors

    Returns
    -------
    Average
        astronomic, in rad

    Raises
    ------
    FixError
        there is no fix, or as many were left out as were used: it is then unknown which are right

    Examples
    --------
    >>> solutions = starpos.replay("night.zip").solutions
    >>> starpos.average([solution.fix for solution in solutions]).frames
    5
    """
    different = {(f.utc_unix_s, f.latitude, f.longitude): f for f in fixes}.values()
    in_order = sorted(different, key=lambda f: f.utc_unix_s)
    averager = _averaged(in_order, 0.0)
    if averager.frame_sigma:
        # the first fixes were judged before anything showed how much all scatter
        averager = _averaged(in_order, averager.frame_sigma)
    whole = averager.average
    if whole is None:
        raise FixError("there is no fix to average: none of the frames has one")
    if whole.frames < MAX_OF_ALL * len(in_order) and (sound := _about_one_place(in_order)):
        # fixes that scatter from pose to pose look like moves before it shows how much they do
        at_rest = _averaged(sound, 0.0).average
        if at_rest is not None and not at_rest.moved and at_rest.frames > whole.frames:
            whole = replace(at_rest, left_out=at_rest.left_out + len(in_order) - len(sound))
    if whole.left_out >= whole.frames:
        raise FixError(
            f"of {whole.frames + whole.left_out} frames {whole.left_out} lie further from the others than their errors "
            f"allow, too many to say which are right: {_why_apart(in_order)}"
        )
    return whole


# sigma within which places that a frozen picture sets apart follow the sky's turn
FOLLOWS_SIGMA = 5.0


def _why_apart(in_order: Sequence[Fix]) -> str:
    """Why the places of frames lie apart, for messages."""
    times = np.array([f.utc_unix_s for f in in_order])
    if not np.ptp(times):
        return "all have the same time: the clock that stamps the frames stands still"
    # seen again at a later time, a sky belongs to a place further west
    west = np.array([f.longitude for f in in_order]) + ROTATION_RAD_S * (times - times[0])
    away = [
        (half_turn(east - west[0]) * math.cos(f.latitude), f.latitude - in_order[0].latitude)
        for f, east in zip(in_order, west, strict=True)
    ]
    sigma = max(math.sqrt(np.trace(f.covariance[:2, :2])) for f in in_order) / EARTH_RADIUS_M
    if np.abs(away).max() < FOLLOWS_SIGMA * sigma:
        return "all show the same sky at different times: the picture stands still, or only its time is new"
    return (
        "the frames are of several places, the mount or the clock slipped, or the instrument turned and its stated A3 is "
        "wrong (--self-calibrate finds it)"
    )


def _averaged(in_order: Sequence[Fix], frame_sigma: float) -> "Averager":
    averager = Averager(frame_sigma)
    for f in in_order:
        averager.include(f)
    averager.look_again()
    return averager


def _about_one_place(in_order: Sequence[Fix]) -> list[Fix]:
    """The fixes of many poses that scatter about one place, with that scatter in their budgets; [] if most do not.

    How much they scatter shows from the smaller steps from pose to pose, as moves and wrong fixes make large ones, and
    then from how far the poses lie from their middle.
    """
    pose = poses_of(in_order)
    if pose[-1] < MIN_STEPS:
        return []
    zeniths = np.array([erfa.s2c(f.longitude, f.latitude) for f in in_order])
    means = np.array([zeniths[pose == k].mean(0) for k in range(pose[-1] + 1)])
    steps = np.sort(np.linalg.norm(np.diff(means, axis=0), axis=1))
    off = np.linalg.norm(means - np.median(means, axis=0), axis=1)
    # squares in units of the sigma per axis are exponential, with a mean of 2; of a step, which two poses share, of 4
    by_steps = steps[int(SMALLER * len(steps))] / np.sqrt(-4 * np.log(1 - SMALLER))
    by_middle = np.median(off) / np.sqrt(2 * np.log(2))
    if by_middle > MAX_POSE_RAD or np.mean(off < GATE_SIGMA * by_steps) < MAX_OF_ALL:
        return []
    near = off < GATE_SIGMA * by_middle
    # what drove on is elsewhere at the end
    if not near[-MOVED_FIXES:].any():
        return []
    return [_with_scatter(f, by_middle) for f, k in zip(in_order, pose, strict=True) if near[k]]


@dataclass(frozen=True, kw_only=True)
class _Track:
    """An average that grows with each fix.

    pose: the first fix since the camera was last touched; in_pose: number of accepted fixes since then.
    claim: the scatter that the fixes show.
    """

    place_filter: PlaceFilter
    pose: Fix
    claim: Claim
    frames: int = 0
    poses: int = 0
    in_pose: int = 0
    mean_unix_s: float = 0.0
    began_unix_s: float = float("nan")

    @classmethod
    def before(cls, f: Fix, frame_sigma: float) -> "_Track":
        """A track without a fix, ready for fixes like `f`; frame_sigma (rad): their scatter beyond their budgets."""
        place_filter = PlaceFilter.before(_with_scatter(f, frame_sigma))
        claim = Claim(frame_sigma=frame_sigma)
        return cls(place_filter=place_filter, pose=f, claim=claim, began_unix_s=f.utc_unix_s)

    def rival(self, f: Fix) -> "_Track":
        """A track without a fix that knows the errors of this one, but not its place."""
        elsewhere = self.place_filter.elsewhere(self._scattered(f))
        return replace(_Track.before(f, self.claim.frame_sigma), place_filter=elsewhere, pose=self.pose)

    def touched(self, f: Fix) -> "_Track":
        """The track after somebody touched the camera; `f` is the first fix since."""
        return replace(self, place_filter=self.place_filter.forget((False, False, True)), pose=f, in_pose=0)

    def begin(self, f: Fix) -> "_Track":
        """The track with its first fix, which nothing can contradict."""
        return self._including(f, self.place_filter.updated(self._scattered(f), self.pose)[0])

    def with_fix(self, f: Fix) -> "_Track | None":
        """The track with one more fix; None if the fix lies too far off."""
        extended, sigmas = self.place_filter.updated(self._scattered(f), self.pose)
        if sigmas > GATE_SIGMA or not extended.straight_from(self.place_filter):
            return None
        return self._including(f, extended)

    def terms(self, last: Fix) -> tuple[ErrorTerm, ...]:
        """The budget of the average, whose last fix is `last`.

        The filter takes the scatter as noise; in truth fixes next to each other are alike, as the claim knows.
        """
        stated = self.place_filter.terms(self._scattered(last).terms)[:-1]
        return (*stated, self.claim.term(SCATTER, last))

    def _scattered(self, f: Fix) -> Fix:
        """The fix with the scatter of those before as one more error of its own."""
        return _with_scatter(f, self.claim.frame_sigma)

    def _including(self, f: Fix, extended: PlaceFilter) -> "_Track":
        frames, poses = self.frames + 1, self.poses + (self.in_pose == 0)
        seen = Remembered.of(f, self.pose, poses, extended.plane)
        return replace(
            self,
            place_filter=extended,
            claim=self.claim.with_fix(seen, extended.east_north_m),
            frames=frames,
            poses=poses,
            in_pose=self.in_pose + 1,
            mean_unix_s=self.mean_unix_s + (f.utc_unix_s - self.mean_unix_s) / frames,
        )


def _with_scatter(f: Fix, sigma: float) -> Fix:
    return replace(f, terms=(*f.terms, ErrorTerm(SCATTER, f.levelling * sigma)))


class Averager:
    """Averages fixes as they come in: `include` them in order of time and read `average`.  Its memory does not grow.

    frame_sigma (rad): scatter of the fixes beyond their budgets, as far as it is known before the first.
    """

    def __init__(self, frame_sigma: float = 0.0) -> None:
        self._begin_sigma = frame_sigma
        self._track: _Track | None = None
        # the average of the fixes since the camera was touched, or since one did not agree
        self._rival: _Track | None = None
        # whether the camera was touched when the rival began
        self._rival_turned = False
        # number of fixes in a row that did not agree
        self._disbelieved = 0
        self._left_out = self._moved = 0
        self._last: Fix | None = None

    @property
    def average(self) -> Average | None:
        """The average so far; None before the first fix."""
        t = self._track
        if t is None or self._last is None:
            return None
        latitude, longitude, heading = t.place_filter.place
        return Average(
            utc_unix_s=t.mean_unix_s,
            latitude=latitude,
            longitude=longitude,
            heading=heading,
            terms=t.terms(self._last),
            frames=t.frames,
            poses=t.poses,
            left_out=self._left_out,
            began_unix_s=t.began_unix_s,
            moved=self._moved,
        )

    @property
    def frame_sigma(self) -> float:
        """Scatter in rad of the fixes beyond their budgets; 0 before the first fix."""
        return self._track.claim.frame_sigma if self._track else 0.0

    def look_again(self) -> None:
        """Look at the scatter of all fixes now, rather than when there are clearly more."""
        if self._track is not None:
            track = self._track
            self._track = replace(track, claim=track.claim.looked_at(track.place_filter.east_north_m))

    def include(self, f: Fix) -> None:
        """Take in one more fix, later than all before."""
        track = self._track
        if track is None:
            self._track, self._last = _Track.before(f, self._begin_sigma).begin(f), f
            return
        slip = slip_s(f.camera, track.pose.camera, f.latitude)
        if slip is None:
            track = self._touch(track, f)
        self._last = f
        extended = None if slip else track.with_fix(f)
        rival = self._rival.with_fix(f) if self._rival else None
        if extended is not None:
            self._track, self._disbelieved = extended, 0
            # a rival that this fix contradicts began with a wrong fix
            if self._rival is not None and rival is None:
                rival = track.rival(f).begin(f) if self._rival_turned else None
            self._rival = rival
            if rival is not None and self._is_elsewhere(extended, rival):
                self._switch(extended, rival, f)
            return
        self._left_out += 1
        self._disbelieved += 1
        if rival is None:
            self._rival_turned &= self._rival is not None
            rival, self._disbelieved = track.rival(f).begin(f), 1
        self._rival = rival
        # while the camera is not touched, only a majority of its fixes may overrule the average
        if self._disbelieved >= MOVED_FIXES if self._rival_turned else rival.frames > track.in_pose:
            self._switch(track, rival, f)

    def _touch(self, track: _Track, f: Fix) -> _Track:
        """The track after the camera was touched: the heading has changed, and the place may have."""
        self._track = track = track.touched(f)
        if self._rival is not None and (self._disbelieved or self._rival.frames < RIVAL_FIXES):
            self._rival = self._rival.touched(f)
        else:
            self._rival = track.rival(f)
        self._rival_turned = True
        return track

    def _is_elsewhere(self, track: _Track, rival: _Track) -> bool:
        return (
            self._rival_turned
            and rival.frames >= MOVED_FIXES
            and track.frames > rival.frames
            and track.place_filter.sigmas_apart(rival.place_filter) > MOVED_SIGMA
        )

    def _switch(self, track: _Track, rival: _Track, f: Fix) -> None:
        """Go on with the rival, whose last fix is `f`, instead of the track."""
        if self._rival_turned:
            self._moved += 1
            self._left_out = 0
        else:
            self._left_out += track.in_pose - rival.frames
        self._track, self._rival, self._disbelieved = replace(rival, pose=f), None, 0

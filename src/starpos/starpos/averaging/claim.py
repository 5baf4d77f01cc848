# SPDX-License-Identifier: Apache-2.0
"""What the fixes of one place say of their own scatter, and what the average has to claim for it.

The filter takes each error as its budget states it. This keeps what is needed of the fixes to see whether they scatter
more, and how alike those next to each other are: the mean of errors that are alike is not much better than one of them.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from starpos._numeric.roots import symmetric_root
from starpos.averaging.filter import Plane
from starpos.averaging.scatter import MAX_ROWS, Frames, Scatter, scatter_of
from starpos.earth.ellipsoid import EARTH_RADIUS_M, zenith_of
from starpos.fix.budget import EACH_POSE, ErrorTerm
from starpos.fix.fix import Fix

# sigma of a place in rad before anything is known of it
ANYWHERE_RAD = np.pi
# number of remembered fixes at which they are averaged two by two
MAX_REMEMBERED = 2 * MAX_ROWS
# one more fix changes little among many: the scatter is computed again after an increase by this share
NEWS = 0.3


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
            attitude=f.camera_to_itrs.T,
            up=f.camera_to_itrs.T @ zenith_of(f.latitude, f.longitude),
            place=plane.seen(f)[:2],
            to_rad=np.linalg.inv(turn @ f.levelling[:3]),
            shared=np.hstack(factors),
            sigma=_sigma(own),
            pose_sigma=_sigma(new),
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


def _sigma(terms: Sequence[ErrorTerm]) -> float:
    return float(np.sqrt(sum(np.trace(t.covariance[:2, :2]) for t in terms) / 2)) / EARTH_RADIUS_M


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

# SPDX-License-Identifier: Apache-2.0
"""Where to look first.  A prior only proposes; what it proposes is verified as everything else is."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from starpos import rotation
from starpos.identification.full import OnFrame
from starpos.identification.pose import Field, Pose, directions
from starpos.identification.sky import Sky
from starpos.identification.verify import TEST_STARS, Match, judged, own_stars

ERROR_PX = 1.5  # how far off the stars may be where the prior is right
BRIGHTEST = 15  # stars of the frame that vote for a shift
REACH = 0.05  # of the frame's width: how far the stars may have moved
AGREE_PX = 3.0  # votes for the same shift
MOST = 4  # proposals of a kind
RING_STARS = 8  # of the frame that vote for an azimuth
J2000_RAD = 2.5e-4  # aberration and most proper motions, which the beacons lack


@dataclass(frozen=True)
class Proposal:
    """A pose, the catalogue's stars on the frame at it or near it, which of the n = min(N, TEST_STARS) brightest stars it
    was made from, own (n,), and among how many it was chosen."""

    pose: Pose
    stars: OnFrame
    own: np.ndarray
    chosen_from: int

    def match(self, field: Field, enough: float) -> Match:
        """Fitted to the stars that agree, unless its log-odds are `enough` without."""
        w = self.stars.directions
        raw = judged(field, self.pose, w, self.own, ERROR_PX, enough)
        if raw.log_odds > enough or len(raw.star) < 2:
            return raw
        pose = self.pose.fitted(field.xy[0, raw.star], raw.directions)
        own = self.own.copy()
        own[raw.star[:2]] = True  # two stars pay for the four parameters of the fit
        return judged(field, pose, w, own, ERROR_PX, enough)


@dataclass(frozen=True)
class Pointing:
    """The attitude (3, 3), `Sky`'s directions into C, is about this, the focal length focal_px."""

    attitude: np.ndarray
    focal_px: float

    def __post_init__(self):
        if not (np.isfinite(self.attitude).all() and 0 < self.focal_px < np.inf):
            raise ValueError("a Pointing needs a finite attitude and a positive focal length")

    def proposals(self, field: Field, sky: Sky) -> Iterator[Proposal]:
        """That nothing has moved; then the shifts that most stars agree on."""
        pose = Pose(self.attitude, self.focal_px, False)
        stars = OnFrame.of(field, sky, pose)
        xy = field.xy[0, : min(len(field), TEST_STARS)]
        yield Proposal(pose, stars, np.zeros(len(xy), bool), 1)
        shift = xy[:BRIGHTEST, None] - pose.project(stars.directions)
        star, near = np.nonzero(np.square(shift).sum(-1) < (2 * REACH * field.half[0]) ** 2)
        shift = shift[star, near]
        for k in _most_voted(np.square(shift[:, None] - shift).sum(-1) < AGREE_PX**2):
            # a shift along x is a turn about the camera's y axis, one along y about its x axis
            x, y = shift[k] / self.focal_px
            moved = replace(pose, attitude=rotation.from_vector([-y, x, 0.0]) @ self.attitude)
            own = own_stars(xy[None], star[None, k : k + 1], field.sigma[: len(xy)])[0]
            yield Proposal(moved, stars, own, len(shift))


@dataclass(frozen=True)
class Plumb:
    """The zenith is known, zenith_sky (3,) among `Sky`'s directions and zenith_camera (3,) in C, to tolerance_rad; which
    way the camera faces is not."""

    zenith_sky: np.ndarray
    zenith_camera: np.ndarray
    tolerance_rad: float

    def __post_init__(self):
        if not np.isfinite([*self.zenith_sky, *self.zenith_camera, self.tolerance_rad]).all():
            raise ValueError("a Plumb needs finite directions and a finite tolerance")

    def proposals(self, field: Field, sky: Sky) -> Iterator[Proposal]:
        """`Pointing`s to the azimuths at which most stars are as far from the zenith as the catalogue's."""
        camera, world = _frame_about(self.zenith_camera), _frame_about(self.zenith_sky)
        seen = directions(field.xy[:1, :RING_STARS], np.array([field.focal_px]))[0] @ camera.T
        distance = np.arctan2(np.hypot(seen[:, 0], seen[:, 1]), seen[:, 2])
        tolerance = self.tolerance_rad + J2000_RAD
        height = sky.triangles.beacons @ self.zenith_sky
        low, high = np.cos(distance.max() + tolerance), np.cos(max(distance.min() - tolerance, 0.0))
        ring = np.flatnonzero((height > low) & (height < high))
        star, near = np.nonzero(np.abs(distance[:, None] - np.arccos(height[ring])) < tolerance)
        known = sky.triangles.beacons[ring[near]] @ world.T
        turn = np.arctan2(seen[star, 1], seen[star, 0]) - np.arctan2(known[:, 1], known[:, 0])
        turn = np.sort(turn % (2 * np.pi))
        window = 2 * tolerance / max(np.sin(np.median(distance)), tolerance)
        turn = np.concatenate([turn, turn[turn < window] + 2 * np.pi])  # the circle closes
        votes = np.searchsorted(turn, turn + window) - np.arange(len(turn))
        pick: list[int] = []
        for k in np.argsort(-votes, kind="stable")[: 10 * MOST].tolist():
            if len(pick) < MOST and all(abs(turn[k] - turn[j]) > window for j in pick):
                pick.append(k)
        for k in pick:
            middle = np.median(turn[k : k + votes[k]])
            attitude = camera.T @ rotation.about_axis(2, middle) @ world
            for p in Pointing(attitude, field.focal_px).proposals(field, sky):
                yield replace(p, chosen_from=p.chosen_from * len(turn))


def _frame_about(pole: np.ndarray) -> np.ndarray:
    """A rotation (3, 3) that takes the pole to the z axis."""
    x = np.cross(pole, np.eye(3)[np.argmin(np.abs(pole))])
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(pole, x), pole])


def _most_voted(agree: np.ndarray) -> list[int]:
    """The rows of agree (P, P) with most votes, none of which votes for another."""
    left, votes, pick = np.ones(len(agree), bool), agree.sum(1), []
    while left.any() and len(pick) < MOST:
        k = int(np.argmax(np.where(left, votes, -1)))
        pick.append(k)
        left &= ~agree[k]
    return pick

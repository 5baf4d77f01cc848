# SPDX-License-Identifier: Apache-2.0
"""Priors: where to look first. A prior only proposes poses; they are verified like all others."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from starpos import rotation
from starpos.earth.ellipsoid import zenith_of
from starpos.earth.orientation import EarthState
from starpos.frozen import at_once
from starpos.identification._frame import FrameStars
from starpos.identification.evidence import SCALE_TOLERANCE, Identification, OnFrame, Prior
from starpos.identification.pose import MATCH_SIGMA, Pose, directions
from starpos.identification.sky import Sky
from starpos.units import ARCSEC

# The stars may be off by this where the prior is right.
ERROR_PX = 5.0
# If the camera has not moved, no star of the frame has moved by more.
STILL_PX = 6.0
# Number of the frame's brightest stars that vote for a shift.
BRIGHTEST = 15
# The stars may have moved by this share of the frame's width.
REACH = 0.05
# Maximum difference of votes for the same shift.
AGREE_PX = 3.0
# Most proposals of one kind.
MOST = 4
# Number of the frame's stars that vote for an azimuth.
RING_STARS = 8
# A zenith that is known less well does not help.
WIDEST_RAD = 0.1
# Tolerance of checks of rotations and unit vectors.
EXACT = 1e-6
# 2.8 km of travel, or an error of the tilt of that size.
PLUMB_TOLERANCE_RAD = 90 * ARCSEC
# Aberration and most proper motions, which the beacons' directions do not include.
J2000_RAD = 2.5e-4
# Logarithm of the probabilities that the camera has stayed as it was, and that it has moved.
STANDS, WAS_MOVED = np.log(0.5), np.log(0.5)

# A pose, the distance (N,) px by which each star may be off, and the Prior it is judged by.
Attempt = tuple[Pose, np.ndarray, Prior]


@at_once
@dataclass(frozen=True)
class PointingPrior:
    """An approximate attitude (3, 3), `Sky`'s directions into C, and focal length (px); ValueError if impossible."""

    attitude: np.ndarray
    focal_px: float

    def __post_init__(self) -> None:
        a = self.attitude
        if not (_unit(a) and np.abs(a @ a.T - np.eye(3)).max() < EXACT and np.linalg.det(a) > 0):
            raise ValueError("a Pointing's attitude must be a rotation (3, 3)")
        if not 0 < self.focal_px < np.inf:
            raise ValueError("a Pointing's focal length must be positive and finite")

    def attempts(self, field: FrameStars, sky: Sky, log_share: float) -> Iterator[Attempt]:
        """Yield the unshifted pose, then shifted ones in order of the stars they match; log_share as in the Prior."""
        pose = Pose(self.attitude, self.focal_px, False)
        radius_px = np.hypot(MATCH_SIGMA * field.sigma, ERROR_PX)
        yield pose, radius_px, self._known(field, STILL_PX, log_share + STANDS)
        reach_px = 2 * REACH * field.half[0]
        prior = self._known(field, reach_px + STILL_PX, log_share + WAS_MOVED)
        xy = field.xy[0, :BRIGHTEST]
        shift = xy[:, None] - pose.project(OnFrame.of(field, sky, pose, field.tested).directions)
        shift = shift[np.square(shift).sum(-1) < reach_px**2]
        for k in _most_voted(np.square(shift[:, None] - shift).sum(-1) < AGREE_PX**2):
            # a shift along x is a turn about the camera's y axis, one along y about its x axis
            x, y = shift[k] / self.focal_px
            turned = rotation.from_vector([-y, x, 0.0]) @ self.attitude
            yield replace(pose, attitude=turned), radius_px, prior

    def reach_rad(self, width: int, height: int) -> float:
        """How far the attitude may be off, rad about each axis, for frames of this size in px to be found by it."""
        return min(REACH * width / self.focal_px, 2 * STILL_PX / float(np.hypot(width, height)))

    def _known(self, field: FrameStars, reach_px: float, log_share: float) -> Prior:
        """The Prior of poses that shift the frame by at most reach_px, and turn and stretch its corners by STILL_PX."""
        shift, turn = reach_px / self.focal_px, STILL_PX / np.hypot(*field.half)
        most = np.array([shift, shift, turn, turn])
        log_density = log_share - float(np.log(2 * most).sum())

        def density(pose: Pose) -> float:
            moved = rotation.to_small_vector(pose.attitude @ self.attitude.T)
            off = np.append(moved, np.log(pose.focal_px / self.focal_px))
            return log_density if (np.abs(off) < most).all() and not pose.mirrored else -math.inf

        return Prior(density, 2 * most)


@at_once
@dataclass(frozen=True)
class PlumbPrior:
    """A known zenith, but an unknown azimuth of the camera; ValueError if impossible.

    zenith_sky     (3,): unit vector among `Sky`'s directions
    zenith_camera  (3,): the same in C
    tolerance_rad  how far off they may be
    """

    zenith_sky: np.ndarray
    zenith_camera: np.ndarray
    tolerance_rad: float

    def __post_init__(self) -> None:
        if not (_unit(self.zenith_sky) and _unit(self.zenith_camera)):
            raise ValueError("a Plumb's zeniths must be unit vectors (3,)")
        if not 0 <= self.tolerance_rad <= WIDEST_RAD:
            raise ValueError(f"a Plumb's tolerance must be from 0 to {WIDEST_RAD:g} rad")

    def attempts(self, field: FrameStars, sky: Sky, log_share: float) -> Iterator[Attempt]:
        """Yield poses at the azimuths for which most stars vote: stars as far from the zenith as in the catalogue."""
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
        # the circle closes
        turn = np.concatenate([turn, turn[turn < window] + 2 * np.pi])
        votes = np.searchsorted(turn, turn + window) - np.arange(len(turn))
        pick: list[int] = []
        for k in np.argsort(-votes, kind="stable")[: 10 * MOST].tolist():
            if len(pick) < MOST and all(abs(turn[k] - turn[j]) > window for j in pick):
                pick.append(k)
        prior = self._known(field, log_share)
        for k in pick:
            middle = np.median(turn[k : k + votes[k]])
            attitude = camera.T @ rotation.about_axis(2, middle) @ world
            for pose, radius_px, _ in PointingPrior(attitude, field.focal_px).attempts(field, sky, log_share):
                yield pose, radius_px, prior

    def _known(self, field: FrameStars, log_share: float) -> Prior:
        """The Prior of poses with the zenith near its place, at any azimuth."""
        reach = self.tolerance_rad + J2000_RAD + 2 * REACH * field.half[0] / field.focal_px
        rotations = np.pi * reach**2 * 2 * np.pi
        log_density = log_share - float(np.log(rotations * 2 * SCALE_TOLERANCE))

        def density(pose: Pose) -> float:
            off = np.linalg.norm(pose.attitude @ self.zenith_sky - self.zenith_camera)
            scale = abs(np.log(pose.focal_px / field.focal_px))
            possible = off < reach and scale < SCALE_TOLERANCE and not pose.mirrored
            return log_density if possible else -math.inf

        return Prior(density, np.append(np.full(3, np.cbrt(rotations)), 2 * SCALE_TOLERANCE))


def _unit(v: np.ndarray) -> bool:
    """Whether v (..., 3) are unit vectors."""
    return bool((np.abs(v) < 2).all() and (np.abs(np.square(v).sum(-1) - 1) < EXACT).all())


def _frame_about(pole: np.ndarray) -> np.ndarray:
    """A rotation (3, 3) that takes the pole to the z axis."""
    x = np.cross(pole, np.eye(3)[np.argmin(np.abs(pole))])
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(pole, x), pole])


def _most_voted(agree: np.ndarray) -> list[int]:
    """At most MOST rows of agree (P, P) with most votes, no two of which vote for each other."""
    pick: list[int] = []
    left, votes = np.ones(len(agree), bool), agree.sum(1)
    while left.any() and len(pick) < MOST:
        k = int(np.argmax(np.where(left, votes, -1)))
        pick.append(k)
        left &= ~agree[k]
    return pick


@at_once
@dataclass(frozen=True)
class Hint:
    """Attitude and place of the camera at the time of a fix.

    itrs_to_camera  (3, 3): ITRS into C
    up_itrs         (3,): the zenith in ITRS
    focal_px        fitted focal length, px
    """

    itrs_to_camera: np.ndarray
    up_itrs: np.ndarray
    focal_px: float

    @classmethod
    def at(
        cls, found: Identification, state: EarthState, focal_px: float, latitude: float, longitude: float
    ) -> "Hint":
        """Make a Hint from an identification, the fitted focal length, and the astronomic place (rad) of its fix."""
        return cls(found.attitude @ state.gcrs_to_itrs.T, zenith_of(latitude, longitude), focal_px)

    def priors(self, state: EarthState, zenith_camera: np.ndarray) -> tuple[PointingPrior, PlumbPrior]:
        """Priors for `identify` at another time: the attitude if nothing moved, and the zenith (3,) in C."""
        return (
            PointingPrior(self.itrs_to_camera @ state.gcrs_to_itrs, self.focal_px),
            PlumbPrior(self.up_itrs @ state.gcrs_to_itrs, zenith_camera, PLUMB_TOLERANCE_RAD),
        )

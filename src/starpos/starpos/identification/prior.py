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
from starpos.identification.evidence import MIRRORED, SCALE_TOLERANCE, Identification, OnFrame, Prior
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
    """An approximate attitude (3, 3), `Sky`'s directions into C, and focal length (px)."""

    attitude: np.ndarray
    focal_px: float

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
    """A known zenith, but an unknown azimuth of the camera.

    zenith_sky     (3,): unit vector among `Sky`'s directions
    zenith_camera  (3,): the same in C
    tolerance_rad  how far off they may be
    """

    zenith_sky: np.ndarray
    zenith_camera: np.ndarray
    tolerance_rad: float

    def attempts(self, field: FrameStars, sky: Sky, log_share: float) -> Iterator[Attempt]:
        """Yield poses at the azimuths for which most stars vote: stars as far from the zenith as in the catalogue."""
        camera, world = _frame_about(self.zenith_camera), _frame_about(self.zenith_sky)
        seen = directions(field.xy[:1, :RING_STARS], np.array([field.focal_px]))[0] @ camera.T
        distance = np.arctan2(np.hypot(seen[:, 0], seen[:, 1]), seen[:, 2])
        tolerance = self.tolerance_rad + J2000_RAD
        assert sky.triangles is not None
        beacons = sky.triangles.beacons
        height = beacons @ self.zenith_sky
        low, high = np.cos(distance.max() + tolerance), np.cos(max(distance.min() - tolerance, 0.0))
        ring = np.flatnonzero((height > low) & (height < high))
        star, near = np.nonzero(np.abs(distance[:, None] - np.arccos(height[ring])) < tolerance)
        known = beacons[ring[near]] @ world.T
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


# Half of the headers' focal lengths are right to this share, half of their pointings to USUALLY_RAD; none is looked for
# beyond AIMED_RAD. The stars of fields that reach beyond WIDEST_AIMED_RAD from their middle do not lie in a plane.
# Numbers of brightest stars: of a frame, whose pairs show poses and whose places judge them; of the catalogue, for each
# area of a frame and in all.
USUAL_SCALE = 0.01
USUALLY_RAD, AIMED_RAD, WIDEST_AIMED_RAD = np.radians([0.3, 1.0, 4.0]).tolist()
AIMED_PAIRS, AIMED_STARS, CATALOGUE_STARS, MOST_STARS = 8, 40, 10, 120


@at_once
@dataclass(frozen=True)
class AimPrior:
    """The direction (3,), among `Sky`'s, of the middle of a frame to within AIMED_RAD, at any roll."""

    toward: np.ndarray

    def attempts(self, field: FrameStars, sky: Sky, log_share: float) -> Iterator[Attempt]:
        """Yield the poses by which most of the brightest stars lie near bright stars of the catalogue."""
        half_rad = float(np.hypot(*field.half)) / field.focal_px
        if half_rad > WIDEST_AIMED_RAD:
            return
        reach_rad = AIMED_RAD + half_rad
        frames = math.pi * (reach_rad * field.focal_px) ** 2 / (4 * field.half.prod())
        near = sky.catalogue.cone(self.toward, reach_rad)[: min(int(CATALOGUE_STARS * frames), MOST_STARS)]
        axes = _frame_about(self.toward)
        at = sky.directions(near) @ axes.T
        # the sky's plane as complex numbers, px; a pose multiplies by `turn` and adds `shift`
        plane = field.focal_px * (at[:, 0] + 1j * at[:, 1]) / at[:, 2]
        radius_px = np.hypot(MATCH_SIGMA * field.sigma, ERROR_PX)
        prior = self._known(field, log_share)
        for mirrored in (False, True):
            seen = field.xy[int(mirrored), :AIMED_STARS] @ [1, 1j]
            for turn, shift in self._most_matched(seen, plane, field):
                z = -shift / turn / field.focal_px
                x = np.array([z.real, z.imag, 1.0])
                right = np.array([(1 / turn).real, (1 / turn).imag, 0.0])
                out = x / np.linalg.norm(x)
                right -= out * (out @ right)
                right /= np.linalg.norm(right)
                attitude = np.stack([right, np.cross(out, right), out]) @ axes
                yield Pose(attitude, field.focal_px * abs(turn), mirrored), radius_px, prior

    def _most_matched(
        self, seen: np.ndarray, plane: np.ndarray, field: FrameStars
    ) -> list[tuple[complex, complex]]:
        """Turns and shifts by which most stars are seen, of all pairs of seen stars and of the catalogue's."""
        one, other = np.triu_indices(min(len(seen), AIMED_PAIRS), 1)
        first, second = np.nonzero(~np.eye(len(plane), dtype=bool))
        # of two detections, or stars, in one place
        with np.errstate(divide="ignore", invalid="ignore"):
            turn = (seen[one] - seen[other])[:, None] / (plane[first] - plane[second])
            alike = np.abs(np.log(np.abs(turn))) < SCALE_TOLERANCE
        shift = seen[one][:, None] - turn * plane[first]
        off = np.abs(shift - field.middle @ [1, 1j]) / field.focal_px
        turn, shift = (v[alike & (off < AIMED_RAD)] for v in (turn, shift))
        # cells of the frame in which a star is seen, and the next ones
        low = field.middle - field.half - 2 * AGREE_PX
        size = (2 * field.half / AGREE_PX).astype(int) + 5
        cells = np.zeros(size, bool)
        column, row = ((np.array([seen.real, seen.imag]) - low[:, None]) / AGREE_PX).astype(int)
        for across, down in np.ndindex(3, 3):
            cells[np.clip(column + across - 1, 0, size[0] - 1), np.clip(row + down - 1, 0, size[1] - 1)] = (
                True
            )
        due = turn[:, None] * plane + shift[:, None]
        column, row = ((part - start) / AGREE_PX for part, start in ((due.real, low[0]), (due.imag, low[1])))
        on = (column >= 0) & (row >= 0) & (column < size[0]) & (row < size[1])
        matched = (on & cells[np.where(on, column, 0).astype(int), np.where(on, row, 0).astype(int)]).sum(1)
        pick: list[tuple[complex, complex]] = []
        for k in np.argsort(-matched, kind="stable")[: 20 * MOST].tolist():
            apart = [abs(shift[k] - b) + field.half.max() * abs(turn[k] - a) for a, b in pick]
            if len(pick) < MOST and min(apart, default=math.inf) > 2 * AGREE_PX:
                pick.append((complex(turn[k]), complex(shift[k])))
        return pick

    def _known(self, field: FrameStars, log_share: float) -> Prior:
        """The Prior of poses that look there, at any roll: within r with a chance like r^2 / (USUALLY_RAD^2 + r^2)."""
        rotations = 2 * math.pi**2 * USUALLY_RAD**2 / (1 + (USUALLY_RAD / AIMED_RAD) ** 2)
        log_density = log_share - math.log(rotations * 2 * SCALE_TOLERANCE)
        middle = np.append(field.middle, field.focal_px)
        middle /= np.linalg.norm(middle)

        def density(pose: Pose) -> float:
            off = np.linalg.norm(middle @ pose.attitude - self.toward)
            scale = abs(np.log(pose.focal_px / field.focal_px))
            if off > AIMED_RAD or scale > SCALE_TOLERANCE:
                return -math.inf
            parity = math.log(MIRRORED if pose.mirrored else 1 - MIRRORED)
            usual = math.log(0.5 + 0.5 * (scale < USUAL_SCALE) * SCALE_TOLERANCE / USUAL_SCALE)
            return float(log_density + parity + usual - 2 * np.log1p((off / USUALLY_RAD) ** 2))

        return Prior(density, np.append(np.full(3, np.cbrt(rotations)), 2 * SCALE_TOLERANCE))


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

# SPDX-License-Identifier: Apache-2.0
"""An attitude: a rotation from the axes of one frame into the axes of another, with its error."""

import math
from dataclasses import KW_ONLY, dataclass
from functools import cached_property

import numpy as np

from starpos import rotation
from starpos.fix.terms import ErrorTerm
from starpos.frozen import at_once

# Names of frames, as docs/frames_and_symbols.md has them.
CAMERA, LINK, ITRS, GCRS, ENU = "camera", "link", "ITRS", "GCRS", "ENU"
# Variance (rad2) of the turn about the only direction that is seen, and from which it is said to be unknown.
ANY_TURN, UNKNOWN_TURN = 10.0, 1.0


@at_once
@dataclass(frozen=True)
class Attitude:
    """A rotation and its error.

    rotation (3, 3): takes components along the axes of the frame `of` to components along the axes of `into`.
    covariance (3, 3): rad2, of its small rotation about the axes of `into`.
    terms: the budget of which `covariance` is the sum; () without one.
    """

    rotation: np.ndarray
    covariance: np.ndarray
    _: KW_ONLY
    of: str
    into: str
    terms: tuple[ErrorTerm, ...] = ()

    def then(self, turn: np.ndarray, into: str) -> "Attitude":
        """The attitude in another frame, without its budget; turn (3, 3): from the axes of `into` to the new ones."""
        return Attitude(turn @ self.rotation, turn @ self.covariance @ turn.T, of=self.of, into=into)

    @property
    def unshared(self) -> np.ndarray:
        """Covariance (3, 3) of the errors that other frames do not share; the whole one without a budget."""
        terms = [t.covariance[3:, 3:] for t in self.terms if not t.common]
        return np.sum([np.zeros((3, 3)), *terms], axis=0) if self.terms else self.covariance

    @property
    def covariance_about_own(self) -> np.ndarray:
        """Covariance (3, 3) in rad2 of the small rotation about the axes of `of`."""
        return self.rotation.T @ self.covariance @ self.rotation

    @property
    def heading(self) -> float:
        """Azimuth (rad, 0 to 2 pi) of a link's x axis, clockwise from north."""
        return heading_of(self.rotation)

    @property
    def pitch(self) -> float:
        """Elevation (rad) of a link's x axis: positive with the nose up, unlike a turn about ROS's y axis."""
        return math.asin(min(max(self.rotation[2, 0], -1.0), 1.0))

    @property
    def roll(self) -> float:
        """Turn (rad, -pi to pi) about a link's x axis: positive with the left side up."""
        return math.atan2(self.rotation[2, 1], self.rotation[2, 2])

    @cached_property
    def angles_covariance(self) -> np.ndarray:
        """Covariance (3, 3) in rad2 of heading, pitch, roll; unbounded where x is vertical."""
        slope = self._slope
        return slope @ self.covariance @ slope.T

    @property
    def _slope(self) -> np.ndarray:
        """Change (3, 3) of heading, pitch, roll for small rotations about east, north, up."""
        east, north, _ = self.rotation[:, 0].tolist()
        level = max(math.hypot(east, north), 1e-6)
        pitch = np.array([north, -east, 0.0]) / level
        # about x itself by all of it, and up to the horizon by what the heading turns
        roll = np.array([east, north, 0.0]) / level**2
        return np.array([heading_row(self.rotation), pitch, roll])


@dataclass(frozen=True, eq=False, kw_only=True)
class CameraAttitude:
    """Attitude of the camera at one time, by its stars alone, or by the Sun alone but for the turn about its direction.

    utc_unix_s: middle of the exposure; stamp_stddev_s, clock_stddev_s: of that stamp, and of the clock that made it
    against UTC.  frame_id: the camera's, in a graph of nodes.
    camera_to_gcrs (3, 3): axes of the camera to the axes of GCRS, which are ICRS's, for directions without annual
    aberration but with refraction and diurnal aberration, which need a place.
    covariance (3, 3): rad2, of its small rotation about the camera's axes.  stars, log_odds: of the identification.
    """

    utc_unix_s: float
    stamp_stddev_s: float
    clock_stddev_s: float
    frame_id: str
    camera_to_gcrs: np.ndarray
    covariance: np.ndarray
    stars: int
    log_odds: float

    @property
    def ray(self) -> np.ndarray | None:
        """The Sun's direction (3,) in C, about which the attitude is not known; None for one by stars."""
        variance, axes = np.linalg.eigh(self.covariance)
        ray = axes[:, 2]
        return math.copysign(1.0, ray[2]) * ray if variance[2] > UNKNOWN_TURN else None


def heading_of(link_to_enu: np.ndarray) -> float:
    """Azimuth (rad, 0 to 2 pi) of the base link's x axis."""
    return rotation.full_turn(np.arctan2(link_to_enu[0, 0], link_to_enu[1, 0]))


def heading_row(link_to_enu: np.ndarray) -> np.ndarray:
    """Change (3,) of the heading for small rotations of the attitude link_to_enu (3, 3) about east, north, up."""
    east, north, up = link_to_enu[:, 0].tolist()
    level = max(east * east + north * north, 1e-12)
    # d azimuth = (north d_east - east d_north) / level, with d(forward) = spin x forward
    return np.array([east * up / level, north * up / level, -1.0])

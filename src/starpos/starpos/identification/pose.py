# SPDX-License-Identifier: Apache-2.0
"""The pose of a pinhole camera among the stars, a frame's stars in pixels from the principal point, and close pairs."""

from dataclasses import dataclass

import numpy as np

from starpos import rotation
from starpos.frozen import at_once
from starpos.identification._found import Identification
from starpos.identification._frame import FrameStars, framed
from starpos.instrument.camera import Camera

# Most steps of a fit; a step below this (rad) is the last one.
STEPS, SMALL_STEP = 2, 3e-5
# Number of a frame's brightest stars that decide, normally and if most of the brightest may be false.
TEST_STARS, CROWD_STARS = 50, 200
# No centroid is better than this.
MIN_SIGMA_PX = 1e-3
# Maximum distance of a star from its predicted place, in sigma.
MATCH_SIGMA = 3.5
# Stars so far beyond the frame (px) need no margin; a margin is at most this share of the frame.
NO_MARGIN_PX, WIDEST_MARGIN = 2.0, 0.25


def stars_at(camera: Camera, seen: np.ndarray, sigma: np.ndarray) -> FrameStars:
    """FrameStars, brightest first, of pixels (N, 2) or unit vectors (N, 3) in C, for a camera without distortion.

    sigma (N,): their errors, px.  ValueError if one of them is not a finite number, or lies behind the camera.
    """
    seen, sigma = np.ascontiguousarray(seen, float), np.ascontiguousarray(sigma, float)
    return framed(seen, sigma, camera, MIN_SIGMA_PX, TEST_STARS, NO_MARGIN_PX, WIDEST_MARGIN)


@at_once
@dataclass(frozen=True)
class Pose:
    """A pose: attitude (3, 3), `Sky`'s directions into C; focal length in px; whether the frame's rows run bottom-up."""

    attitude: np.ndarray
    focal_px: float
    mirrored: bool

    @classmethod
    def of(cls, field: FrameStars, found: Identification) -> "Pose":
        """The pose that an identification of a frame gives."""
        return cls(found.attitude, field.focal_px * found.focal_scale, found.mirrored)

    def project(self, w: np.ndarray) -> np.ndarray:
        """Pixels (N, 2) of directions w (N, 3); directions behind the camera become pixels far away."""
        u = w @ self.attitude.T
        return u[:, :2] * (self.focal_px / np.maximum(u[:, 2:], 1e-6))


def directions(xy: np.ndarray, focal_px: np.ndarray) -> np.ndarray:
    """Unit vectors (K, N, 3) in C of pixels xy (K, N, 2) from the principal point, with focal lengths (K,)."""
    v = np.empty((*xy.shape[:2], 3))
    v[..., :2] = xy
    v[..., 2] = focal_px[:, None]
    return rotation.normalised(v)


def close_pairs(xy: np.ndarray, reach_px: float) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of the points xy (N, 2) closer than reach_px: two arrays of rows (M,), the smaller row first."""
    # slow to import, and seldom needed
    from scipy.spatial import cKDTree

    one, other = cKDTree(xy).query_pairs(reach_px, output_type="ndarray").T
    return one, other


def mutual_nearest(
    xy: np.ndarray, predicted: np.ndarray, radius: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of xy (N, 2) and predicted (S, 2) that are each other's nearest within radius (N,) px: two arrays of rows."""
    # slow to import, and seldom needed
    from scipy.spatial import cKDTree

    if not (len(xy) and len(predicted)):
        return np.zeros(0, int), np.zeros(0, int)
    distance, nearest = cKDTree(predicted).query(xy)
    back = cKDTree(xy).query(predicted)[1]
    good = (distance < radius) & (back[nearest] == np.arange(len(xy)))
    return np.flatnonzero(good), nearest[good]

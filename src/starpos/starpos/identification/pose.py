# SPDX-License-Identifier: Apache-2.0
"""The pose of a pinhole camera among the stars, and a frame's stars in pixels from the principal point."""

from dataclasses import dataclass

import numpy as np

from starpos import rotation
from starpos.identification._frame import FrameStars
from starpos.identification._poses import fitted
from starpos.instrument.camera import Camera

# Most steps of a fit; a step below this (rad) is the last one.
STEPS, SMALL_STEP = 2, 3e-5
# Number of a frame's brightest stars that decide, normally and if most of the brightest may be false.
TEST_STARS, CROWD_STARS = 50, 200
# No centroid is better than this.
MIN_SIGMA_PX = 1e-3
# Maximum distance of a star from its predicted place, in sigma.
MATCH_SIGMA = 3.5


def stars_at(camera: Camera, xy: np.ndarray, sigma: np.ndarray) -> FrameStars:
    """FrameStars at pixels xy (N, 2) of an ideal camera with square pixels, with errors (N,) px, brightest first.

    ValueError if a pixel or an error is not a finite number.
    """
    if not (np.isfinite(xy).all() and np.isfinite(sigma).all()):
        raise ValueError("stars to be identified need finite pixels and errors: leave the others out")
    principal = np.array([camera.cx, camera.cy])
    flipped = np.stack([xy[:, 0], camera.height - 1 - xy[:, 1]], -1)
    return FrameStars(
        xy=np.stack([xy, flipped]) - principal,
        sigma=np.maximum(sigma, MIN_SIGMA_PX),
        middle=np.array(camera.centre_px) - principal,
        half=np.array([camera.width, camera.height]) / 2,
        focal_px=camera.fx,
        area_px2=float(camera.width * camera.height),
        tested=TEST_STARS,
    )


@dataclass(frozen=True)
class Pose:
    """A pose: attitude (3, 3), `Sky`'s directions into C; focal length in px; whether the frame's rows run bottom-up."""

    attitude: np.ndarray
    focal_px: float
    mirrored: bool

    def project(self, w: np.ndarray) -> np.ndarray:
        """Pixels (N, 2) of directions w (N, 3); directions behind the camera become pixels far away."""
        u = w @ self.attitude.T
        return u[:, :2] * (self.focal_px / np.maximum(u[:, 2:], 1e-6))

    def fitted(self, xy: np.ndarray, w: np.ndarray, sigma_px: np.ndarray) -> "Pose":
        """Fit attitude and focal length to pixels xy (N, 2), with errors sigma_px (N,), of directions w (N, 3)."""
        attitude, focal_px = fitted(xy, w, sigma_px, self.attitude, self.focal_px, STEPS, SMALL_STEP)
        return Pose(attitude, focal_px, self.mirrored)


@dataclass(frozen=True)
class Poses:
    """K poses: attitude (K, 3, 3), focal_px (K,), mirrored (K,)."""

    attitude: np.ndarray
    focal_px: np.ndarray
    mirrored: np.ndarray

    def __getitem__(self, k: int) -> Pose:
        return Pose(self.attitude[k], float(self.focal_px[k]), bool(self.mirrored[k]))

    def __len__(self) -> int:
        return len(self.focal_px)


def directions(xy: np.ndarray, focal_px: np.ndarray) -> np.ndarray:
    """Unit vectors (K, N, 3) in C of pixels xy (K, N, 2) from the principal point, with focal lengths (K,)."""
    v = np.empty((*xy.shape[:2], 3))
    v[..., :2] = xy
    v[..., 2] = focal_px[:, None]
    return rotation.normalised(v)

# SPDX-License-Identifier: Apache-2.0
"""The pose of a pinhole camera among the stars, and a frame's stars in pixels from the principal point."""

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from starpos import rotation
from starpos.core.frame import Frame
from starpos.core.poses import fitted
from starpos.instrument.camera import Camera

# Most steps of a fit; a step below this (rad) is the last one.
STEPS, SMALL_STEP = 2, 3e-5
# So many of a frame's brightest stars decide, and so many where most of the brightest may be false.
TEST_STARS, CROWD_STARS = 50, 200
# No centroid is better than this.
LEAST_SIGMA_PX = 1e-3
# A star lies within so many sigma of its place.
MATCH_SIGMA = 3.5


@dataclass(frozen=True, kw_only=True)
class FrameStars:
    """N stars of a frame, brightest first.

    xy        (2, N, 2) px from the principal point, as they are and with the frame's rows flipped
    sigma     (N,) px, their errors along one axis
    middle    (2, 2) px, the centre of the part of the frame that shows something, as it is and with its rows flipped
    half      (2,) px, half the size of that part
    focal_px  approximate focal length
    area_px2  area over which false detections are spread; never more than the true one
    tested    so many of the brightest decide whether a pose is right
    """

    xy: np.ndarray
    sigma: np.ndarray
    middle: np.ndarray
    half: np.ndarray
    focal_px: float
    area_px2: float
    tested: int = TEST_STARS

    @classmethod
    def of(cls, xy: np.ndarray, sigma: np.ndarray, camera: Camera, margin_px: int = 0) -> "FrameStars":
        """Make FrameStars from pixels xy (N, 2) of an ideal camera whose frame has margins with few detections.

        ValueError if a pixel or an error is not a finite number.
        """
        if not (np.isfinite(xy).all() and np.isfinite(sigma).all()):
            raise ValueError("stars to be identified need finite pixels and errors: leave the others out")
        principal = np.array([camera.cx, camera.cy])
        flipped = np.stack([xy[:, 0], camera.height - 1 - xy[:, 1]], -1)
        return cls(
            xy=np.stack([xy, flipped]) - principal,
            sigma=np.maximum(sigma, LEAST_SIGMA_PX),
            middle=np.tile(np.array(camera.centre_px) - principal, (2, 1)),
            half=np.array([camera.width, camera.height]) / 2,
            focal_px=camera.fx,
            area_px2=float((camera.width - 2 * margin_px) * (camera.height - 2 * margin_px)),
        )

    def __len__(self) -> int:
        return len(self.sigma)

    def take(self, row: np.ndarray) -> "FrameStars":
        """The stars of these rows, in the same order."""
        return replace(self, xy=np.ascontiguousarray(self.xy[:, row]), sigma=self.sigma[row])

    def within(self, low: np.ndarray, high: np.ndarray, share: float) -> "FrameStars":
        """The stars of a frame of which only a share of the area, from low (2,) to high (2,) px, shows something.

        What is hidden counts neither against a pose whose stars would be there, nor as area for false detections.
        """
        first, last = (
            np.maximum(low, self.middle[0] - self.half),
            np.minimum(high, self.middle[0] + self.half),
        )
        middle = (first + last) / 2
        # of rows that are flipped, the sum of the two stays
        flipped = np.array([middle[0], self.middle[:, 1].sum() - middle[1]])
        return replace(
            self,
            middle=np.stack([middle, flipped]),
            half=(last - first) / 2,
            area_px2=self.area_px2 * share,
        )

    @cached_property
    def compiled(self) -> Frame:
        """The stars, for the compiled core; the cone about the middle has some margin."""
        radius_rad = math.atan(math.hypot(*self.half.tolist()) / self.focal_px) * 1.05 + 2e-4
        return Frame(
            self.xy,
            self.sigma,
            self.middle,
            self.half,
            self.focal_px,
            radius_rad,
            self.area_px2,
            self.tested,
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

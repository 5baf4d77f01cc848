# SPDX-License-Identifier: Apache-2.0
"""A pinhole camera among the stars, and the frame's stars as it sees them: pixels from the principal point."""

from dataclasses import dataclass

import numpy as np

from starpos import rotation
from starpos.instrument.camera import Camera

STEPS, SMALL_STEP = 2, 3e-5  # of a fit; rad
LEAST_SIGMA_PX = 1e-3  # no centroid is better, whatever is said


@dataclass(frozen=True, kw_only=True)
class FrameStars:
    """A frame's stars, brightest first.

    xy (2, N, 2): px from the principal point, as they are and with the frame's rows flipped; sigma (N,): their errors;
    middle (2,): the frame's centre; half (2,): half its size; focal_px: as the camera is believed to be; area_px2: of
    where detections are by chance, never too large.
    """

    xy: np.ndarray
    sigma: np.ndarray
    middle: np.ndarray
    half: np.ndarray
    focal_px: float
    area_px2: float

    @classmethod
    def of(cls, xy: np.ndarray, sigma: np.ndarray, camera: Camera, margin_px: int = 0) -> "FrameStars":
        """From pixels (N, 2) of an ideal camera, whose frame has margins that few detections lie on.

        ValueError where a pixel or an error is no finite number.
        """
        if not (np.isfinite(xy).all() and np.isfinite(sigma).all()):
            raise ValueError("stars to be identified need finite pixels and errors: leave the others out")
        principal = np.array([camera.cx, camera.cy])
        flipped = np.stack([xy[:, 0], camera.height - 1 - xy[:, 1]], -1)
        return cls(
            xy=np.stack([xy, flipped]) - principal,
            sigma=np.maximum(sigma, LEAST_SIGMA_PX),
            middle=np.array(camera.centre_px) - principal,
            half=np.array([camera.width, camera.height]) / 2,
            focal_px=camera.fx,
            area_px2=float((camera.width - 2 * margin_px) * (camera.height - 2 * margin_px)),
        )

    def __len__(self) -> int:
        return len(self.sigma)

    @property
    def whole_px2(self) -> float:
        """Of the frame, and of its margins."""
        return float(4 * self.half[0] * self.half[1])

    @property
    def radius_rad(self) -> float:
        """Of a cone about the frame's centre that holds the frame."""
        return float(np.arctan(np.hypot(*self.half) / self.focal_px)) * 1.05 + 2e-4

    def holds(self, pixel: np.ndarray) -> np.ndarray:
        """Which of pixels (N, 2) are on the frame (N,)."""
        on = np.abs(pixel - self.middle) < self.half + 2
        return on[..., 0] & on[..., 1]


@dataclass(frozen=True)
class Pose:
    """attitude (3, 3): Sky into C; focal length in px; whether the frame's rows run bottom-up."""

    attitude: np.ndarray
    focal_px: float
    mirrored: bool

    def project(self, w: np.ndarray) -> np.ndarray:
        """Pixels (N, 2) of directions w (N, 3); far away for what is behind the camera."""
        u = w @ self.attitude.T
        return u[:, :2] * (self.focal_px / np.maximum(u[:, 2:], 1e-6))

    def fitted(self, xy: np.ndarray, w: np.ndarray, sigma_px: np.ndarray) -> "Pose":
        """Least squares for a small rotation and the focal length: pixels xy (N, 2), good to sigma_px (N,), of directions
        w (N, 3)."""
        pose, weight = self, 1 / sigma_px[:, None]
        for _ in range(STEPS):
            pixel, slope = slopes(pose, w)
            j = (slope * weight[:, None]).reshape(-1, 4)
            residual = ((xy - pixel) * weight).ravel()
            try:
                *turn, scale = np.linalg.solve(j.T @ j, j.T @ residual).tolist()
            except np.linalg.LinAlgError:  # all stars in one place
                break
            step = max(map(abs, (*turn, scale)))
            if not step < 1:  # nor where it is no number
                break
            turned = rotation.from_vector(turn) @ pose.attitude
            pose = Pose(turned, pose.focal_px * (1 + scale), pose.mirrored)
            if step < SMALL_STEP:  # whose square is what is left
                break
        return pose


def slopes(pose: Pose, w: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (N, 2) of directions w (N, 3), and how they go (N, 2, 4) with small rotations (rad) of C about its axes and
    with the logarithm of the focal length."""
    u = w @ pose.attitude.T
    x, y = (u[:, :2] / u[:, 2:]).T
    slope = np.empty((len(w), 2, 4))
    slope[:, 0, 0], slope[:, 0, 1], slope[:, 0, 2], slope[:, 0, 3] = -x * y, 1 + x * x, -y, x
    slope[:, 1, 0], slope[:, 1, 1], slope[:, 1, 2], slope[:, 1, 3] = -1 - y * y, x * y, x, y
    slope *= pose.focal_px
    return slope[:, :, 3].copy(), slope


@dataclass(frozen=True)
class Poses:
    """K of them: attitude (K, 3, 3), focal_px (K,), mirrored (K,)."""

    attitude: np.ndarray
    focal_px: np.ndarray
    mirrored: np.ndarray

    def __getitem__(self, k: int) -> Pose:
        return Pose(self.attitude[k], float(self.focal_px[k]), bool(self.mirrored[k]))

    def __len__(self) -> int:
        return len(self.focal_px)

    @classmethod
    def of_triangles(cls, xy: np.ndarray, w: np.ndarray, focal_px: float, mirrored: np.ndarray) -> "Poses":
        """The focal lengths that give triangles at pixels xy (K, 3, 2) the size they have among the stars, w (K, 3, 3),
        and the rotations that bring them into place."""
        wanted = _perimeter(w)
        focal = np.full(len(xy), float(focal_px))
        for _ in range(2):
            focal = focal * _perimeter(directions(xy, focal)) / wanted
        return cls(rotation.best_rotation(w, directions(xy, focal)), focal, mirrored)


def directions(xy: np.ndarray, focal_px: np.ndarray) -> np.ndarray:
    """Unit vectors (K, N, 3) in C of pixels (K, N, 2) from the principal point, focal lengths (K,)."""
    v = np.empty((*xy.shape[:2], 3))
    v[..., :2] = xy
    v[..., 2] = focal_px[:, None]
    return rotation.normalised(v)


def _perimeter(v: np.ndarray) -> np.ndarray:
    """Of triangles (K, 3, 3), along the chords."""
    side = v - v[:, [1, 2, 0]]
    return np.sqrt(np.einsum("kni,kni->kn", side, side)).sum(1)

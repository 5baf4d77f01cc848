# SPDX-License-Identifier: Apache-2.0
"""The pose of a pinhole camera among the stars, and a frame's stars in pixels from the principal point."""

from dataclasses import dataclass

import numpy as np

from starpos import rotation
from starpos.instrument.camera import Camera

# Most steps of a fit; a step below this (rad) is the last one.
STEPS, SMALL_STEP = 2, 3e-5
# So many of a frame's brightest stars decide, and so many where most of the brightest may be false.
TEST_STARS, CROWD_STARS = 50, 200
# No centroid is better than this.
LEAST_SIGMA_PX = 1e-3


@dataclass(frozen=True, kw_only=True)
class FrameStars:
    """N stars of a frame, brightest first.

    xy        (2, N, 2) px from the principal point, as they are and with the frame's rows flipped
    sigma     (N,) px, their errors along one axis
    middle    (2,) px, the frame's centre
    half      (2,) px, half its size
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
            middle=np.array(camera.centre_px) - principal,
            half=np.array([camera.width, camera.height]) / 2,
            focal_px=camera.fx,
            area_px2=float((camera.width - 2 * margin_px) * (camera.height - 2 * margin_px)),
        )

    def __len__(self) -> int:
        return len(self.sigma)

    @property
    def whole_px2(self) -> float:
        """Area of the frame, including its margins."""
        return float(4 * self.half[0] * self.half[1])

    @property
    def radius_rad(self) -> float:
        """Radius of a cone about the frame's centre that contains the frame."""
        return float(np.arctan(np.hypot(*self.half) / self.focal_px)) * 1.05 + 2e-4

    def holds(self, pixel: np.ndarray) -> np.ndarray:
        """Whether pixels (N, 2) are on the frame (N,)."""
        on = np.abs(pixel - self.middle) < self.half + 2
        return on[..., 0] & on[..., 1]


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
        pose, weight = self, 1 / sigma_px[:, None]
        for _ in range(STEPS):
            pixel, slope = slopes(pose, w)
            j = (slope * weight[:, None]).reshape(-1, 4)
            residual = ((xy - pixel) * weight).ravel()
            try:
                *turn, scale = np.linalg.solve(j.T @ j, j.T @ residual).tolist()
            # all stars in one place
            except np.linalg.LinAlgError:
                break
            step = max(map(abs, (*turn, scale)))
            # true for NaN too
            if not step < 1:
                break
            turned = rotation.from_vector(turn) @ pose.attitude
            pose = Pose(turned, pose.focal_px * (1 + scale), pose.mirrored)
            # the remaining error is about its square
            if step < SMALL_STEP:
                break
        return pose


def slopes(pose: Pose, w: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (N, 2) of directions w (N, 3), and their derivatives (N, 2, 4).

    The derivatives are by small rotations (rad) about C's axes and by the logarithm of the focal length.
    """
    u = w @ pose.attitude.T
    x, y = (u[:, :2] / u[:, 2:]).T
    slope = np.empty((len(w), 2, 4))
    slope[:, 0, 0], slope[:, 0, 1], slope[:, 0, 2], slope[:, 0, 3] = -x * y, 1 + x * x, -y, x
    slope[:, 1, 0], slope[:, 1, 1], slope[:, 1, 2], slope[:, 1, 3] = -1 - y * y, x * y, x, y
    slope *= pose.focal_px
    return slope[:, :, 3].copy(), slope


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

    @classmethod
    def of_triangles(cls, xy: np.ndarray, w: np.ndarray, focal_px: float, mirrored: np.ndarray) -> "Poses":
        """Poses that bring the stars of triangles, directions w (K, 3, 3), to the pixels xy (K, 3, 2).

        The focal length makes a triangle's perimeter right, then the rotation brings it into place.
        """
        wanted = _perimeter(w)
        focal = np.full(len(xy), float(focal_px))
        for _ in range(2):
            focal = focal * _perimeter(directions(xy, focal)) / wanted
        return cls(rotation.best_rotation(w, directions(xy, focal)), focal, mirrored)


def directions(xy: np.ndarray, focal_px: np.ndarray) -> np.ndarray:
    """Unit vectors (K, N, 3) in C of pixels xy (K, N, 2) from the principal point, with focal lengths (K,)."""
    v = np.empty((*xy.shape[:2], 3))
    v[..., :2] = xy
    v[..., 2] = focal_px[:, None]
    return rotation.normalised(v)


def _perimeter(v: np.ndarray) -> np.ndarray:
    """Perimeters (K,) of triangles of unit vectors (K, 3, 3), along the chords."""
    side = v - v[:, [1, 2, 0]]
    return np.sqrt(np.einsum("kni,kni->kn", side, side)).sum(1)

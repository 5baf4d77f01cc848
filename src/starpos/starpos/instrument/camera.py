# SPDX-License-Identifier: Apache-2.0
"""Turn pixels into unit vectors of the camera frame C and back: a pinhole with Brown-Conrady distortion.

Pixel (0, 0) is the centre of the top-left pixel; C has x right, y down, z out along the optical axis.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from starpos.errors import InstrumentError

MAX_NEWTON_STEPS = 30


@dataclass(frozen=True, kw_only=True)
class Camera:
    """Intrinsics of a camera, as in sensor_msgs/CameraInfo; InstrumentError for impossible values.

    width, height  px of the frame
    fx, fy         focal lengths, px
    cx, cy         principal point, px
    distortion     `plumb_bob`: k1, k2, p1, p2, k3
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        numbers = (self.fx, self.fy, self.cx, self.cy, *self.distortion)
        if self.width < 1 or self.height < 1:
            raise InstrumentError(f"camera size {self.width} x {self.height} px: both must be at least 1")
        if not all(map(math.isfinite, numbers)):
            raise InstrumentError(
                "camera intrinsics hold a number that is not finite: calibrate the camera again"
            )
        if self.fx <= 0 or self.fy <= 0:
            raise InstrumentError(f"focal length {self.fx} x {self.fy} px: must be positive")
        if len(self.distortion) != 5:
            raise InstrumentError(f"{len(self.distortion)} distortion terms: plumb_bob has 5, k1 k2 p1 p2 k3")

    @classmethod
    def from_focal(cls, width: int, height: int, focal_px: float) -> "Camera":
        """An ideal camera: square pixels, principal point at the frame's centre, no distortion."""
        return cls(
            width=width, height=height, fx=focal_px, fy=focal_px, cx=(width - 1) / 2, cy=(height - 1) / 2
        )

    @property
    def scale_arcsec(self) -> float:
        """Plate scale on the optical axis, arcsec per px."""
        return float(np.degrees(1 / np.sqrt(self.fx * self.fy)) * 3600)

    @property
    def half_diagonal_rad(self) -> float:
        """Angle from the frame's centre to its corner, without distortion."""
        return float(np.arctan(0.5 * np.hypot(self.width / self.fx, self.height / self.fy)))

    @property
    def centre_px(self) -> tuple[float, float]:
        """The frame's centre (not the principal point), px."""
        return (self.width - 1) / 2, (self.height - 1) / 2

    def scaled(self, factor: float) -> "Camera":
        """The camera with its focal lengths multiplied by `factor`."""
        return replace(self, fx=self.fx * factor, fy=self.fy * factor)

    def directions(self, x: ArrayLike, y: ArrayLike) -> np.ndarray:
        """Unit vectors (N, 3) in C of pixels x, y (N,): W = (X, Y, f) / norm, after undistortion.

        The paper prints another third component; docs/the_paper.md#star-vectors says why it is f.

        Raises InstrumentError where the distortion cannot be inverted.
        """
        x, y = (np.asarray(x, float) - self.cx) / self.fx, (np.asarray(y, float) - self.cy) / self.fy
        v = np.ones((*x.shape, 3))
        v[..., 0], v[..., 1] = x, y
        if any(self.distortion):
            v[..., :2] = self._undistort(v[..., :2])
        return v / np.sqrt(np.einsum("...i,...i->...", v, v))[..., None]

    def project(self, v: ArrayLike) -> np.ndarray:
        """Pixels (N, 2) of directions v (N, 3) in C; NaN behind the camera."""
        v = np.asarray(v, float)
        z = np.where(v[..., 2] > 0, v[..., 2], np.nan)
        plane = v[..., :2] / z[..., None]
        if any(self.distortion):
            plane = _distort(plane, self.distortion)
        return plane * [self.fx, self.fy] + [self.cx, self.cy]

    def _undistort(self, target: np.ndarray) -> np.ndarray:
        """Invert the distortion on the tangent plane by Newton's method, which needs only a few steps."""
        plane = target.copy()
        # it may diverge, or meet a fold of the distortion
        with np.errstate(all="ignore"):
            for _ in range(MAX_NEWTON_STEPS):
                residual = _distort(plane, self.distortion) - target
                if np.max(np.abs(residual), initial=0.0) < 1e-14:
                    break
                (a, b), (c, d) = np.moveaxis(_distortion_jacobian(plane, self.distortion), (-2, -1), (0, 1))
                u, v = np.moveaxis(residual, -1, 0)
                plane = plane - np.stack([d * u - b * v, a * v - c * u], -1) / (a * d - b * c)[..., None]
            # solutions beyond a fold are wrong: they are mirrored, or lie on the other side of the axis
            upright = np.linalg.det(_distortion_jacobian(plane, self.distortion)) > 0
            upright &= np.sum(plane * target, -1) >= 0
        if np.max(np.abs(residual), initial=0.0) < 1e-12 and upright.all():
            return plane
        raise InstrumentError(
            f"distortion {self.distortion} cannot be inverted inside the frame: calibrate the camera again"
        )


def _distort(plane: np.ndarray, d: tuple[float, ...]) -> np.ndarray:
    """Apply Brown-Conrady distortion (OpenCV's `plumb_bob`) to tangent-plane coordinates (..., 2)."""
    k1, k2, p1, p2, k3 = d
    x, y = plane[..., 0], plane[..., 1]
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    return np.stack(
        [
            x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
            y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
        ],
        -1,
    )


def _distortion_jacobian(plane: np.ndarray, d: tuple[float, ...]) -> np.ndarray:
    """Derivatives (..., 2, 2) of the distorted coordinates by the undistorted ones."""
    k1, k2, p1, p2, k3 = d
    x, y = plane[..., 0], plane[..., 1]
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    # d radial / dx = slope * x
    slope = 2 * (k1 + r2 * (2 * k2 + r2 * 3 * k3))
    off = x * y * slope + 2 * p1 * x + 2 * p2 * y
    xx = radial + x * x * slope + 2 * p1 * y + 6 * p2 * x
    yy = radial + y * y * slope + 6 * p1 * y + 2 * p2 * x
    return np.stack([np.stack([xx, off], -1), np.stack([off, yy], -1)], -2)

# SPDX-License-Identifier: Apache-2.0
"""ROS's lens model `plumb_bob`, Brown and Conrady's distortion of a pinhole's picture: k1, k2, p1, p2, k3.

The plane is the tangent plane of the unit sphere on the optical axis.
"""

import numpy as np

from starpos.errors import InstrumentError

COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3")
MAX_NEWTON_STEPS = 30


def seen(v: np.ndarray, d: tuple[float, ...]) -> np.ndarray:
    """Places (..., 2) on the distorted plane of directions v (..., 3) in C; NaN behind the camera."""
    z = np.where(v[..., 2] > 0, v[..., 2], np.nan)
    plane = v[..., :2] / z[..., None]
    return _distort(plane, d) if any(d) else plane


def slopes(v: np.ndarray, d: tuple[float, ...]) -> np.ndarray:
    """Derivatives (..., 2, 3) of `seen`."""
    z = np.where(v[..., 2] > 0, v[..., 2], np.nan)
    plane = v[..., :2] / z[..., None]
    out = np.zeros((*v.shape[:-1], 2, 3))
    out[..., 0, 0] = out[..., 1, 1] = 1 / z
    out[..., 2] = -plane / z[..., None]
    return _distortion_jacobian(plane, d) @ out if any(d) else out


def rays(plane: np.ndarray, d: tuple[float, ...]) -> np.ndarray:
    """Directions (..., 3), not normalised, of places (..., 2) on the distorted plane.

    Raises InstrumentError where the distortion cannot be inverted.
    """
    v = np.ones((*plane.shape[:-1], 3))
    v[..., :2] = _undistort(plane, d) if any(d) else plane
    return v


def _undistort(target: np.ndarray, d: tuple[float, ...]) -> np.ndarray:
    """Invert the distortion on the tangent plane by Newton's method, which needs only a few steps."""
    plane = target.copy()
    # it may diverge, or meet a fold of the distortion
    with np.errstate(all="ignore"):
        for _ in range(MAX_NEWTON_STEPS):
            residual = _distort(plane, d) - target
            if np.max(np.abs(residual), initial=0.0) < 1e-14:
                break
            (a, b), (c, e) = np.moveaxis(_distortion_jacobian(plane, d), (-2, -1), (0, 1))
            u, v = np.moveaxis(residual, -1, 0)
            plane = plane - np.stack([e * u - b * v, a * v - c * u], -1) / (a * e - b * c)[..., None]
        # solutions beyond a fold are wrong: they are mirrored, or lie on the other side of the axis
        upright = np.linalg.det(_distortion_jacobian(plane, d)) > 0
        upright &= np.sum(plane * target, -1) >= 0
    if np.max(np.abs(residual), initial=0.0) < 1e-12 and upright.all():
        return plane
    raise InstrumentError(f"distortion {d} cannot be inverted inside the frame: calibrate the camera again")


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

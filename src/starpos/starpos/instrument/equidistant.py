# SPDX-License-Identifier: Apache-2.0
"""ROS's lens model `equidistant`, of fisheyes: Kannala and Brandt's k1, k2, k3, k4, as OpenCV's cv2.fisheye has it.

A direction theta off the axis is seen theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8) focal lengths from
the principal point, also where theta is beyond 90 deg. Out to where that distance no longer grows the lens has a picture.
"""

import math
from functools import lru_cache

import numpy as np

COEFFICIENTS = ("k1", "k2", "k3", "k4")
# Steps of Newton's method, which falls back to halves, and where it has converged, rad.
MAX_STEPS, SETTLED = 60, 1e-15
# Sine of an angle off the axis that is as good as none.
LEAST_OFF = 1e-12


def seen(v: np.ndarray, d: tuple[float, ...]) -> np.ndarray:
    """Places (..., 2), in focal lengths, of directions v (..., 3) in C; NaN beyond the lens's picture."""
    off = np.hypot(v[..., 0], v[..., 1])
    theta = np.arctan2(off, v[..., 2])
    theta = np.where(theta < reach(d), theta, np.nan)
    stretch = np.divide(_distance(theta, d), off, out=np.ones_like(theta), where=~(off == 0))
    # straight behind has no direction on the plane
    stretch = np.where(np.isnan(theta), np.nan, stretch)
    return v[..., :2] * stretch[..., None]


def slopes(v: np.ndarray, d: tuple[float, ...]) -> np.ndarray:
    """Derivatives (..., 2, 3) of `seen`."""
    off = np.maximum(np.hypot(v[..., 0], v[..., 1]), LEAST_OFF)
    theta = np.arctan2(off, v[..., 2])
    theta = np.where(theta < reach(d), theta, np.nan)
    outward = v[..., :2] / off[..., None]
    # on the axis any azimuth will do
    outward[off == LEAST_OFF] = 1.0, 0.0
    stretch = _distance(theta, d) / off
    # away from the axis the angle grows, around it the direction of the place turns
    grows = np.concatenate([outward * v[..., 2:], -off[..., None]], -1)
    grows *= (_slope(theta, d) / np.square(v).sum(-1))[..., None]
    across = stretch[..., None, None] * (np.eye(2) - outward[..., :, None] * outward[..., None, :])
    out = outward[..., :, None] * grows[..., None, :]
    out[..., :2] += across
    return out


def rays(plane: np.ndarray, d: tuple[float, ...]) -> np.ndarray:
    """Directions (..., 3) of places (..., 2), in focal lengths; NaN beyond the lens's picture."""
    distance = np.hypot(plane[..., 0], plane[..., 1])
    theta = angles(distance, d)
    stretch = np.divide(np.sin(theta), distance, out=np.ones_like(theta), where=~(distance == 0))
    return np.concatenate([plane * stretch[..., None], np.cos(theta)[..., None]], -1)


def angles(distance: np.ndarray, d: tuple[float, ...]) -> np.ndarray:
    """Angles (...) off the axis, rad, that are seen at distances (...) in focal lengths; NaN beyond the picture."""
    distance = np.asarray(distance, float)
    low, high = np.zeros_like(distance), np.full_like(distance, reach(d))
    theta = np.minimum(distance, high)
    for _ in range(MAX_STEPS):
        error = _distance(theta, d) - distance
        low, high = np.where(error > 0, low, theta), np.where(error > 0, theta, high)
        with np.errstate(divide="ignore", invalid="ignore"):
            new = theta - error / _slope(theta, d)
        new = np.where((new >= low) & (new <= high), new, (low + high) / 2)
        step, theta = np.max(np.abs(new - theta), initial=0.0), new
        if step < SETTLED:
            break
    return np.where(distance < picture(d), theta, np.nan)


@lru_cache(maxsize=64)
def reach(d: tuple[float, ...]) -> float:
    """The angle off the axis, rad, out to which the lens has a picture; at most pi."""
    # of the slope, by the square of the angle
    roots = np.roots([9 * d[3], 7 * d[2], 5 * d[1], 3 * d[0], 1.0])
    turning = [r.real for r in roots if r.real > 0 and abs(r.imag) < 1e-9 * abs(r)]
    return min(math.sqrt(min(turning, default=math.inf)), math.pi)


def picture(d: tuple[float, ...]) -> float:
    """The radius of the lens's picture, in focal lengths."""
    return float(_distance(np.array(reach(d)), d))


def _distance(theta: np.ndarray, d: tuple[float, ...]) -> np.ndarray:
    """Distances (...) in focal lengths at which angles theta (...) rad off the axis are seen."""
    k1, k2, k3, k4 = d
    t2 = theta * theta
    return theta * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))


def _slope(theta: np.ndarray, d: tuple[float, ...]) -> np.ndarray:
    """Derivative (...) of `_distance`."""
    k1, k2, k3, k4 = d
    t2 = theta * theta
    return 1 + t2 * (3 * k1 + t2 * (5 * k2 + t2 * (7 * k3 + t2 * 9 * k4)))

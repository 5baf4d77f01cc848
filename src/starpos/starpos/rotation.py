# SPDX-License-Identifier: Apache-2.0
"""Small tools for rotation matrices (3, 3) and unit vectors; angles in rad, rotations active."""

import math

import numpy as np
from numpy.typing import ArrayLike


def full_turn(angle: float) -> float:
    """The angle in rad, brought to [0, 2 pi)."""
    # a modulo alone brings the smallest negative angle to 2 pi
    turned = float(angle % (2 * np.pi))
    return 0.0 if turned >= 2 * np.pi else turned


def half_turns(angles: np.ndarray) -> np.ndarray:
    """The angles in rad, brought to [-pi, pi)."""
    return (angles + np.pi) % (2 * np.pi) - np.pi


def half_turn(angle: float) -> float:
    """The angle in rad, brought to [-pi, pi)."""
    return float(half_turns(np.asarray(angle)))


def unit_vector(longitude: ArrayLike, latitude: ArrayLike) -> np.ndarray:
    """Unit vectors (..., 3) of longitude and latitude, or of right ascension and declination, in rad."""
    across = np.cos(latitude)
    return np.stack([across * np.cos(longitude), across * np.sin(longitude), np.sin(latitude)], -1)


def normalised(v: np.ndarray) -> np.ndarray:
    """Vectors (..., 3) scaled to unit length."""
    return v / np.sqrt(np.einsum("...i,...i->...", v, v))[..., None]


def about_axis(axis: int, angle: float) -> np.ndarray:
    """Rotation about coordinate axis 0, 1 or 2."""
    c, s = np.cos(angle), np.sin(angle)
    i, j = ((1, 2), (2, 0), (0, 1))[axis]
    r = np.eye(3)
    r[i, i] = r[j, j] = c
    r[i, j], r[j, i] = -s, s
    return r


def from_vector(v: ArrayLike) -> np.ndarray:
    """Rotation by |v| rad about v (3,) (Rodrigues)."""
    x, y, z = np.asarray(v, float).tolist()
    angle2 = x * x + y * y + z * z
    angle = math.sqrt(angle2)
    s = math.sin(angle) / angle if angle > 1e-8 else 1.0
    c = (1 - math.cos(angle)) / angle2 if angle > 1e-4 else 0.5 - angle2 / 24
    return np.array(
        [
            [1 - c * (y * y + z * z), c * x * y - s * z, c * x * z + s * y],
            [c * x * y + s * z, 1 - c * (x * x + z * z), c * y * z - s * x],
            [c * x * z - s * y, c * y * z + s * x, 1 - c * (x * x + y * y)],
        ]
    )


def shortest_turn(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Smallest rotation (3, 3) that takes the unit vector a to b, both (3,)."""
    (ax, ay, az), (bx, by, bz) = a.tolist(), b.tolist()
    x, y, z = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    cosine = ax * bx + ay * by + az * bz
    if cosine < -0.9:
        sine = math.hypot(x, y, z)
        if sine < 1e-12:
            return from_vector(np.pi * np.linalg.svd(a[None])[2][1])
        return from_vector(np.array([x, y, z]) * (math.atan2(sine, cosine) / sine))
    k = 1 / (1 + cosine)
    return np.array(
        [
            [cosine + k * x * x, k * x * y - z, k * x * z + y],
            [k * x * y + z, cosine + k * y * y, k * y * z - x],
            [k * x * z - y, k * y * z + x, cosine + k * z * z],
        ]
    )


def mean_rotation(rotations: np.ndarray, weight: np.ndarray | None = None) -> np.ndarray:
    """The rotation (3, 3) nearest to all of rotations (N, 3, 3), by least squares; weight (N,), or 1."""
    axes = np.tile(np.eye(3), (len(rotations), 1))
    each = None if weight is None else np.repeat(weight, 3)
    return best_rotation(axes, np.concatenate(rotations.swapaxes(1, 2)), each)


def to_small_vector(r: np.ndarray) -> np.ndarray:
    """The rotation vector (3,) of a rotation by much less than 1 rad."""
    return 0.5 * np.array([r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]])


def to_vector(r: np.ndarray) -> np.ndarray:
    """The rotation vector (3,) of any rotation, of at most pi rad."""
    x, y, z, w = to_quaternion(r).tolist()
    sine = math.hypot(x, y, z)
    return np.array([x, y, z]) * (2 * math.atan2(sine, w) / sine if sine else 2.0)


def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Vector products (..., 3) of a and b, both (..., 3): as `np.cross`, which takes several times as long for a few."""
    (ax, ay, az), (bx, by, bz) = (np.moveaxis(v, -1, 0) if v.ndim > 1 else v for v in (a, b))
    return np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], -1)


def angle(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Angles (...) in rad between vectors a and b, both (..., 3), exact also where they are tiny or near pi."""
    return np.arctan2(np.linalg.norm(cross(a, b), axis=-1), np.einsum("...i,...i->...", a, b))


def cross_matrix(v: ArrayLike) -> np.ndarray:
    """The matrix (3, 3) [v]x, so that cross_matrix(v) @ w = v x w."""
    x, y, z = np.asarray(v, float).tolist()
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def cross_matrices(v: np.ndarray) -> np.ndarray:
    """The matrices (N, 3, 3) of `cross_matrix` of vectors (N, 3)."""
    x, y, z = v.T
    o = np.zeros_like(x)
    return np.stack([np.stack([o, -z, y], -1), np.stack([z, o, -x], -1), np.stack([-y, x, o], -1)], -2)


def best_rotation(source: np.ndarray, target: np.ndarray, weight: np.ndarray | None = None) -> np.ndarray:
    """Rotations R (..., 3, 3) that bring R source closest to target, both (..., N, 3) unit vectors.

    weight (..., N), or 1. This is Wahba's problem, solved by singular values (Markley 1988, J. Astronaut. Sci. 36, 245).
    """
    if weight is not None:
        target = target * weight[..., None]
    u, _, vt = np.linalg.svd(np.swapaxes(target, -1, -2) @ source)
    u[..., 2] *= np.sign(np.linalg.det(u @ vt))[..., None]
    return u @ vt


def to_quaternion(r: np.ndarray) -> np.ndarray:
    """Unit quaternion (x, y, z, w) of a rotation matrix, w >= 0 (Bar-Itzhack 2000, J. Guid. Control Dyn. 23, 1085)."""
    twist = np.array([r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]])
    trace = np.trace(r)
    k = np.block([[r + r.T - trace * np.eye(3), twist[:, None]], [twist, trace]])
    q = np.linalg.eigh(k)[1][:, 3]
    return q if q[3] >= 0 else -q


def from_quaternion(q: ArrayLike) -> np.ndarray:
    """Rotation matrix (3, 3) of a quaternion (x, y, z, w) that is not zero, of whatever length."""
    x, y, z, w = np.asarray(q, float) / np.linalg.norm(q)
    spin = cross_matrix([x, y, z])
    return np.eye(3) + 2 * w * spin + 2 * spin @ spin

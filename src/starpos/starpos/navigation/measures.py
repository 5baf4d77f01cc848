# SPDX-License-Identifier: Apache-2.0
"""Equations of single nodes: attitude by stars, measured velocity, standstill, law of motion; what is known before."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from starpos.earth.gravity import SPIN, geodetic_place, zenith_at
from starpos.navigation.imu import ImuModel
from starpos.navigation.laws import MotionLaw
from starpos.navigation.links import crosses
from starpos.navigation.motion import (
    ACCEL_BIAS,
    ACCEL_MATRIX,
    BY_LAW,
    CONSTANTS,
    DRIFT,
    GYRO_BIAS,
    GYRO_MATRIX,
    LAG,
    LOG_AXES,
    LOG_SCALE,
    MEASURED,
    MOUNT,
    PLACE,
    REFRACTION,
    SPEED,
    TURN,
    VELOCITY,
    Motion,
)
from starpos.navigation.preintegration import Pieces, Sums

# number of readings whose mean is the rate at a frame
RATE_READINGS = 5
# nothing is known of it before: place m, velocity m/s, attitude rad
NO_PLACE, NO_VELOCITY, NO_TURN = 2e7, 1e3, 10.0


@dataclass(frozen=True, kw_only=True)
class Beforehand:
    """What is known before the voyage, 1 sigma: mount rad an axis, share of refraction, height m.

    log_scale, log_axes, lag_s: of the measured velocity (a share; rad an axis) and of the camera's stamps (s).
    """

    mount: float
    refraction: float
    height_m: float
    height_stddev_m: float
    log_scale: float = 0.01
    log_axes: float = 0.005
    lag_s: float = 0.005


@dataclass(frozen=True, eq=False, kw_only=True)
class StarAttitudes:
    """Attitudes of the camera at F of the nodes: index (F,), camera_to_itrs (F, 3, 3), as `StarAttitude` has them.

    covariance (F, 3, 3), by_refraction (F, 3); stamp_stddev_s (F,).
    """

    index: np.ndarray
    camera_to_itrs: np.ndarray
    covariance: np.ndarray
    by_refraction: np.ndarray
    stamp_stddev_s: np.ndarray


@dataclass(frozen=True, eq=False, kw_only=True)
class Lacks:
    """Equations (F, 3, n + m + 1) of some nodes, index (F,), not whitened, and covariances (F, 3, 3) of their errors."""

    index: np.ndarray
    rows: np.ndarray
    covariance: np.ndarray

    def whitened(self, count: int) -> np.ndarray:
        """Equations (count, 3, n + m + 1) of all nodes, with zeros at nodes without one."""
        all_rows = np.zeros((count, *self.rows.shape[1:]))
        if len(self.index):
            all_rows[self.index] = np.linalg.solve(np.linalg.cholesky(self.covariance), self.rows)
        return all_rows

    def distance2(self, covariance: np.ndarray, left_out: np.ndarray) -> np.ndarray:
        """Squared residuals (F,) over what they should scatter by, given a solution's covariance (K, n + m, n + m).

        left_out (F,): which of them had no part in the solution.
        """
        slope, short = self.rows[..., :-1], self.rows[..., -1]
        explained = slope @ covariance[self.index] @ slope.transpose(0, 2, 1)
        root = np.linalg.cholesky(self.covariance)
        share = np.linalg.solve(root, np.linalg.solve(root, explained).transpose(0, 2, 1))
        size, axes = np.linalg.eigh(share)
        # a solution takes its own error from the residuals it has seen, at most nearly all, and adds it to others
        spread = np.where(left_out[:, None], 1 + size, np.maximum(1 - size, MIN_LEFT))
        seen = np.einsum("kji,kj->ki", axes, np.linalg.solve(root, short[..., None])[..., 0])
        return np.sum(seen**2 / spread, 1)


MIN_LEFT = 0.02


def star_lacks(motion: Motion, stars: StarAttitudes, sums: Sums, pieces: Pieces, n: int) -> Lacks:
    """Equations of the frames with stars: the camera's attitude by the body's, the mount and the lag."""
    k = stars.index
    camera = motion.attitude[k] @ motion.camera_to_body
    off = Rotation.from_matrix(stars.camera_to_itrs.transpose(0, 2, 1) @ camera).as_rotvec()
    rate = _rates(sums, pieces)[k] - np.einsum("kji,j->ki", motion.attitude[k], SPIN)
    rate = rate @ motion.camera_to_body
    rows = np.zeros((len(k), 3, n + CONSTANTS + 1))
    rows[:, :, TURN] = camera.transpose(0, 2, 1)
    constants = rows[:, :, n:-1]
    constants[:, :, MOUNT] = np.eye(3)
    constants[:, :, LAG] = rate[..., None]
    constants[:, :, REFRACTION] = -stars.by_refraction[..., None]
    rows[:, :, -1] = stars.by_refraction * motion.refraction - rate * motion.lag_s - off
    smeared = rate[:, :, None] * rate[:, None, :] * (stars.stamp_stddev_s**2)[:, None, None]
    return Lacks(index=k, rows=rows, covariance=stars.covariance + smeared)


def _rates(sums: Sums, pieces: Pieces) -> np.ndarray:
    """Turn rates (K, 3) of the body at the nodes, rad/s."""
    here = (pieces.length_s > 0)[..., None]
    first = slice(0, RATE_READINGS)
    rate = (sums.rates * here)[:, first].sum(1) / np.maximum(here[:, first].sum(1), 1)
    return np.concatenate([rate, rate[-1:]])


def velocity_lacks(motion: Motion, index: np.ndarray, missed: np.ndarray, sigma: np.ndarray, n: int) -> Lacks:
    """Equations of nodes (F,) with velocities, missed (F, 3) by so much, measured less predicted, with 1 sigma (F,)."""
    attitude = motion.attitude[index]
    through = motion.velocity[index] - motion.drift[index]
    forward = np.einsum("kji,kj->ki", attitude, through)
    rows = np.zeros((len(index), 3, n + CONSTANTS + 1))
    rows[:, :, VELOCITY] = attitude.transpose(0, 2, 1)
    rows[:, :, TURN] = attitude.transpose(0, 2, 1) @ crosses(through)
    if n == BY_LAW:
        rows[:, :, DRIFT] = -attitude.transpose(0, 2, 1)
    constants = rows[:, :, n:-1]
    constants[:, :, LOG_SCALE] = forward[..., None]
    constants[:, :, LOG_AXES] = -crosses(forward)
    rows[:, :, -1] = missed
    return Lacks(index=index, rows=rows, covariance=(sigma**2)[:, None, None] * np.eye(3))


def standing_lacks(motion: Motion, index: np.ndarray, sigma: float, n: int) -> Lacks:
    """Equations of nodes (F,) at which the vehicle stands, within sigma m/s."""
    rows = np.zeros((len(index), 3, n + CONSTANTS + 1))
    rows[:, :, VELOCITY] = np.eye(3)
    rows[:, :, -1] = -motion.velocity[index]
    return Lacks(index=index, rows=rows, covariance=np.tile(sigma**2 * np.eye(3), (len(index), 1, 1)))


def law_lacks(motion: Motion, law: MotionLaw) -> Lacks:
    """Equations of the nodes whose velocity is known only from the motion law: speed along the nose, drift, rest."""
    up, count = zenith_at(motion.place), len(motion)
    level = np.eye(3) - up[:, :, None] * up[:, None, :]
    nose = np.einsum("kij,kj->ki", level, motion.attitude[:, :, 0])
    nose /= np.linalg.norm(nose, axis=1, keepdims=True)
    drift = np.einsum("kij,kj->ki", level, motion.drift)
    rows = np.zeros((count, 3, BY_LAW + CONSTANTS + 1))
    rows[:, :, VELOCITY] = np.eye(3)
    rows[:, :, SPEED] = -nose[..., None]
    rows[:, :, DRIFT] = -level
    aside = np.cross(up, nose) * motion.speed[:, None]
    rows[:, :, TURN] = -aside[:, :, None] * up[:, None, :]
    rows[:, :, -1] = nose * motion.speed[:, None] + drift - motion.velocity
    apart_s = float(np.median(np.diff(motion.utc_unix_s)))
    upward = up[:, :, None] * up[:, None, :]
    covariance = law.rest_at(apart_s) ** 2 * level + law.climb_at(apart_s) ** 2 * upward
    return Lacks(index=np.arange(count), rows=rows, covariance=covariance)


def first_rows(motion: Motion, model: ImuModel, known: Beforehand, law: MotionLaw | None) -> np.ndarray:
    """Whitened equations (P, n + m + 1) of the first node and the constants: what is known beforehand."""
    n = MEASURED if law is None else BY_LAW
    sigma, value = np.empty(n + CONSTANTS), np.zeros(n + CONSTANTS)
    for columns, stddev, now in (
        (PLACE, NO_PLACE, 0.0),
        (VELOCITY, NO_VELOCITY, 0.0),
        (TURN, NO_TURN, 0.0),
        (GYRO_BIAS, model.gyroscope_bias_stddev, motion.gyro_bias[0]),
        (ACCEL_BIAS, model.accelerometer_bias_stddev, motion.accel_bias[0]),
    ):
        sigma[columns], value[columns] = stddev, now
    if law is not None:
        sigma[SPEED], value[SPEED] = law.speed_stddev, motion.speed[0]
        sigma[DRIFT], value[DRIFT] = law.drift_stddev, motion.drift[0]
    matrix = np.where(np.eye(3, dtype=bool), model.scale_stddev, model.axes_stddev).ravel()
    nominal = Rotation.from_matrix(motion.nominal.T @ motion.camera_to_body).as_rotvec()
    for columns, spread, now in (
        (MOUNT, known.mount, nominal),
        (GYRO_MATRIX, matrix, motion.gyro_matrix.ravel()),
        (ACCEL_MATRIX, matrix, motion.accel_matrix.ravel()),
        (LOG_SCALE, known.log_scale, motion.log_scale),
        (LOG_AXES, known.log_axes, motion.log_axes),
        (LAG, known.lag_s, motion.lag_s),
        (REFRACTION, max(known.refraction, 1e-6), motion.refraction),
    ):
        sigma[n:][columns], value[n:][columns] = spread, now
    rows = np.zeros((n + CONSTANTS + 1, n + CONSTANTS + 1))
    rows[np.arange(n + CONSTANTS), np.arange(n + CONSTANTS)] = 1 / sigma
    rows[:-1, -1] = -value / sigma
    _, _, height = geodetic_place(motion.place[0])
    rows[-1, PLACE] = zenith_at(motion.place[0]) / known.height_stddev_m
    rows[-1, -1] = (known.height_m - float(height)) / known.height_stddev_m
    return rows

# SPDX-License-Identifier: Apache-2.0
"""The unknowns of a voyage: what each node has and what is constant, as values and as columns of an adjustment."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

# Columns of a node: place m and velocity m/s in ITRS, attitude as a small rotation about ITRS's axes in rad, biases of
# gyro and accelerometer. If a law of motion stands in for a velocity: also speed along the nose and drift in ITRS
PLACE, VELOCITY, TURN = slice(0, 3), slice(3, 6), slice(6, 9)
GYRO_BIAS, ACCEL_BIAS = slice(9, 12), slice(12, 15)
SPEED, DRIFT = slice(15, 16), slice(16, 19)
MEASURED, BY_LAW = 15, 19
# columns of the constants: mount as a small rotation about the camera's axes, matrices of gyro and accelerometer,
# row-major, scale and axes of the measured velocity, lag of the IMU's stamps behind the camera's, s, share of refraction
MOUNT, GYRO_MATRIX, ACCEL_MATRIX = slice(0, 3), slice(3, 12), slice(12, 21)
LOG_SCALE, LOG_AXES, LAG, REFRACTION = slice(21, 22), slice(22, 25), slice(25, 26), slice(26, 27)
CONSTANTS = 27


@dataclass(frozen=True, eq=False, kw_only=True)
class Motion:
    """A voyage at K nodes, at times utc_unix_s (K,).

    attitude (K, 3, 3): body into ITRS.  place, velocity (K, 3): ITRS, m and m/s over ground.
    gyro_bias, accel_bias (K, 3); speed (K,), drift (K, 3) of a law of motion.
    camera_to_body (3, 3), and as it was believed to be, nominal.  gyro_matrix, accel_matrix
    (3, 3): what readings are too large by, as shares.  log_scale, log_axes (3,): of measured velocities, as a share and
    a small rotation.  lag_s, refraction: see the columns.
    """

    utc_unix_s: np.ndarray
    attitude: np.ndarray
    place: np.ndarray
    velocity: np.ndarray
    gyro_bias: np.ndarray
    accel_bias: np.ndarray
    speed: np.ndarray
    drift: np.ndarray
    camera_to_body: np.ndarray
    nominal: np.ndarray
    gyro_matrix: np.ndarray
    accel_matrix: np.ndarray
    log_scale: float = 0.0
    log_axes: np.ndarray
    lag_s: float = 0.0
    refraction: float = 0.0

    def __len__(self) -> int:
        return len(self.utc_unix_s)

    def part(self, nodes: np.ndarray) -> "Motion":
        """Copies of some of its nodes (K,), by their numbers."""
        names = ("utc_unix_s", "attitude", "place", "velocity", "gyro_bias", "accel_bias", "speed", "drift")
        return replace(self, **{name: getattr(self, name)[nodes] for name in names})

    def moved(self, nodes: np.ndarray, constants: np.ndarray) -> "Motion":
        """The voyage after small changes of its nodes (K, n) and its constants (m,)."""
        turned = Rotation.from_rotvec(nodes[:, TURN]).as_matrix() @ self.attitude
        by_law = nodes.shape[1] == BY_LAW
        return replace(
            self,
            attitude=turned,
            place=self.place + nodes[:, PLACE],
            velocity=self.velocity + nodes[:, VELOCITY],
            gyro_bias=self.gyro_bias + nodes[:, GYRO_BIAS],
            accel_bias=self.accel_bias + nodes[:, ACCEL_BIAS],
            speed=self.speed + nodes[:, SPEED][:, 0] if by_law else self.speed,
            drift=self.drift + nodes[:, DRIFT] if by_law else self.drift,
            camera_to_body=self.camera_to_body @ Rotation.from_rotvec(constants[MOUNT]).as_matrix(),
            gyro_matrix=self.gyro_matrix + constants[GYRO_MATRIX].reshape(3, 3),
            accel_matrix=self.accel_matrix + constants[ACCEL_MATRIX].reshape(3, 3),
            log_scale=self.log_scale + float(constants[LOG_SCALE][0]),
            log_axes=self.log_axes + constants[LOG_AXES],
            lag_s=self.lag_s + float(constants[LAG][0]),
            refraction=self.refraction + float(constants[REFRACTION][0]),
        )

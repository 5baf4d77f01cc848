# SPDX-License-Identifier: Apache-2.0
"""Equations between a node and the next: strapdown mechanisation in ITRS, by what an IMU's readings add up to.

At each node inertial axes are laid along ITRS, in which the readings are summed; until the next one ITRS turns with the
Earth.  There is no latitude or longitude in it, so that poles and 180 deg are like other places.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from starpos.earth.gravity import SPIN, gravity, gravity_gradient
from starpos.earth.orientation import ROTATION_RAD_S
from starpos.navigation.imu import ImuModel
from starpos.navigation.laws import MotionLaw
from starpos.navigation.motion import (
    ACCEL_BIAS,
    ACCEL_MATRIX,
    BY_LAW,
    CONSTANTS,
    DRIFT,
    GYRO_BIAS,
    GYRO_MATRIX,
    MEASURED,
    PLACE,
    SPEED,
    TURN,
    VELOCITY,
    Motion,
)
from starpos.navigation.preintegration import ERRORS, Pieces, Sums

SPINNING = np.array([[0.0, -ROTATION_RAD_S, 0.0], [ROTATION_RAD_S, 0.0, 0.0], [0.0, 0.0, 0.0]])
# what may happen in the time of a missing reading: turns in rad/s, changes of speed in m/s2
LOST_RATE, LOST_FORCE = 1.0, 5.0
# a missing reading counts from this share of an interval on
LOST_SHARE = 1e-3


@dataclass(frozen=True, eq=False, kw_only=True)
class NextNodes:
    """Where K - 1 nodes' readings lead to at the next node: place, velocity (K - 1, 3) and attitude (K - 1, 3, 3)."""

    place: np.ndarray
    velocity: np.ndarray
    attitude: np.ndarray


def arrived(motion: Motion, sums: Sums, span_s: np.ndarray) -> NextNodes:
    """Carry each node but the last on to the next."""
    dt = span_s[:, None]
    place, velocity, attitude = motion.place[:-1], motion.velocity[:-1], motion.attitude[:-1]
    speed, way = _turned(attitude, sums.speed), _turned(attitude, sums.way)
    inertial = velocity + np.cross(SPIN, place)
    begin = attraction(place)
    # attraction changes evenly on the way, by far the most because the Earth turns
    end = attraction(place + inertial * dt + (way + begin * dt**2 / 2))
    place = place + inertial * dt + way + (2 * begin + end) * dt**2 / 6
    inertial = inertial + speed + (begin + end) * dt / 2
    back = turned_back(span_s)
    return NextNodes(
        place=_turned(back, place),
        velocity=_turned(back, inertial - np.cross(SPIN, place)),
        attitude=back @ attitude @ sums.turn,
    )


def attraction(place: np.ndarray) -> np.ndarray:
    """Gravitational attraction (..., 3) at places (..., 3): gravity without the centrifugal force."""
    return gravity(place) + np.cross(SPIN, np.cross(SPIN, place))


def turned_back(span_s: np.ndarray) -> np.ndarray:
    """Rotations (K, 3, 3) of axes that stay into those that turn with the Earth for these times (K,)."""
    return Rotation.from_rotvec(np.outer(-span_s, SPIN)).as_matrix()


@dataclass(frozen=True, eq=False, kw_only=True)
class Links:
    """Equations (K - 1, n, 2 n + m + 1) of nodes, the next ones and constants, and their covariances (K - 1, n, n)."""

    rows: np.ndarray
    covariance: np.ndarray

    def whitened(self) -> np.ndarray:
        """The equations as `chain.Chain` has them."""
        return np.linalg.solve(np.linalg.cholesky(self.covariance), self.rows)

    def noisier(self, density2: np.ndarray, pieces: Pieces) -> "Links":
        """The equations with so much more density (K - 1,) of the force's noise, (m/s2)2/Hz."""
        covariance = self.covariance.copy()
        _add_force_noise(covariance, density2[:, None, None], pieces.span_s[:, None, None])
        return Links(rows=self.rows, covariance=covariance)

    @property
    def log_determinant(self) -> float:
        """Half the logarithm of the covariances' determinants."""
        return float(np.linalg.slogdet(self.covariance)[1].sum() / 2)


def links_of(motion: Motion, sums: Sums, pieces: Pieces, model: ImuModel, law: MotionLaw | None) -> Links:
    """The equations by which the readings carry each node on to the next."""
    n = MEASURED if law is None else BY_LAW
    span, count = pieces.span_s, len(motion) - 1
    dt = span[:, None, None]
    attitude = motion.attitude[:-1]
    speed, way = (_turned(attitude, v) for v in (sums.speed, sums.way))
    back, unit = turned_back(span), np.eye(3)
    pull = gravity_gradient(motion.place[:-1]) + SPINNING @ SPINNING
    onward = np.tile(np.eye(n), (count, 1, 1))
    # in the axes that stay
    onward[:, PLACE, PLACE] = unit + SPINNING * dt + pull * dt**2 / 2
    onward[:, PLACE, VELOCITY] = unit * dt
    onward[:, PLACE, TURN] = -crosses(way)
    onward[:, VELOCITY, PLACE] = SPINNING + pull * dt
    onward[:, VELOCITY, TURN] = -crosses(speed)
    constants = np.zeros((count, n, CONSTANTS))
    columns = (GYRO_BIAS, GYRO_MATRIX), (ACCEL_BIAS, ACCEL_MATRIX)
    for state, slope in ((PLACE, sums.way_slope), (VELOCITY, sums.speed_slope), (TURN, sums.turn_slope)):
        along = attitude @ slope
        for (bias, matrix), first in zip(columns, range(0, slope.shape[2], ERRORS), strict=False):
            onward[:, state, bias] = along[:, :, first : first + 3]
            constants[:, state, matrix] = along[:, :, first + 3 : first + ERRORS]
    # and into those that turned, where the Earth's own velocity is taken off
    onward[:, VELOCITY] -= SPINNING @ onward[:, PLACE]
    constants[:, VELOCITY] -= SPINNING @ constants[:, PLACE]
    for state in (PLACE, VELOCITY, TURN):
        onward[:, state] = back @ onward[:, state]
        constants[:, state] = back @ constants[:, state]
    rows = np.concatenate(
        [
            -onward,
            np.tile(np.eye(n), (count, 1, 1)),
            -constants,
            _misclosure(motion, sums, span, n)[..., None],
        ],
        -1,
    )
    return Links(rows=rows, covariance=_noise(speed / span[:, None], pieces, model, law, n))


def _misclosure(motion: Motion, sums: Sums, span_s: np.ndarray, n: int) -> np.ndarray:
    """What each node lacks (K - 1, n) against what arrives from the one before."""
    there = arrived(motion, sums, span_s)
    short = np.zeros((len(span_s), n))
    short[:, PLACE] = there.place - motion.place[1:]
    short[:, VELOCITY] = there.velocity - motion.velocity[1:]
    short[:, TURN] = Rotation.from_matrix(there.attitude @ motion.attitude[1:].transpose(0, 2, 1)).as_rotvec()
    short[:, GYRO_BIAS] = -np.diff(motion.gyro_bias, axis=0)
    short[:, ACCEL_BIAS] = -np.diff(motion.accel_bias, axis=0)
    if n == BY_LAW:
        short[:, SPEED] = -np.diff(motion.speed)[:, None]
        short[:, DRIFT] = -np.diff(motion.drift, axis=0)
    return short


def _noise(force: np.ndarray, pieces: Pieces, model: ImuModel, law: MotionLaw | None, n: int) -> np.ndarray:
    """Covariance (K - 1, n, n) of what the readings' noise adds up to, under mean forces (K - 1, 3) in ITRS."""
    dt, unit = pieces.span_s[:, None, None], np.eye(3)
    gyro = model.gyroscope_noise_density**2
    tilting = -crosses(force)
    tilted = tilting @ tilting.transpose(0, 2, 1)
    noise = np.zeros((len(dt), n, n))
    noise[:, TURN, TURN] = gyro * dt * unit
    noise[:, VELOCITY, TURN] = gyro * dt**2 / 2 * tilting
    noise[:, PLACE, TURN] = gyro * dt**3 / 6 * tilting
    noise[:, VELOCITY, VELOCITY] = gyro * dt**3 / 3 * tilted
    noise[:, PLACE, VELOCITY] = gyro * dt**4 / 8 * tilted
    noise[:, PLACE, PLACE] = gyro * dt**5 / 20 * tilted
    for first, second in ((PLACE, VELOCITY), (PLACE, TURN), (VELOCITY, TURN)):
        noise[:, second, first] = noise[:, first, second].transpose(0, 2, 1)
    _add_force_noise(noise, model.accelerometer_noise_density**2, dt)
    noise[:, GYRO_BIAS, GYRO_BIAS] = model.gyroscope_random_walk**2 * dt * unit
    noise[:, ACCEL_BIAS, ACCEL_BIAS] = model.accelerometer_random_walk**2 * dt * unit
    if law is not None:
        noise[:, SPEED, SPEED] = law.speed_walk**2 * dt
        noise[:, DRIFT, DRIFT] = law.drift_walk**2 * dt * unit
    lost = np.where(pieces.missing_s > LOST_SHARE * pieces.span_s, pieces.missing_s, 0.0)[:, None, None]
    noise[:, TURN, TURN] += (LOST_RATE * lost) ** 2 * unit
    noise[:, VELOCITY, VELOCITY] += (LOST_FORCE * lost) ** 2 * unit
    noise[:, PLACE, PLACE] += (LOST_FORCE * lost * dt) ** 2 * unit
    return noise


def _add_force_noise(noise: np.ndarray, density2: float | np.ndarray, dt: np.ndarray) -> None:
    """Add white noise of the force, of a density (K - 1, 1, 1) in (m/s2)2/Hz, over times dt (K - 1, 1, 1)."""
    unit = np.eye(3) * density2
    noise[:, VELOCITY, VELOCITY] += dt * unit
    noise[:, PLACE, VELOCITY] += dt**2 / 2 * unit
    noise[:, VELOCITY, PLACE] += dt**2 / 2 * unit
    noise[:, PLACE, PLACE] += dt**3 / 3 * unit


def crosses(v: np.ndarray) -> np.ndarray:
    """Matrices (K, 3, 3) of the cross products with vectors (K, 3)."""
    x, y, z = v.T
    o = np.zeros_like(x)
    return np.stack([np.stack([o, -z, y], -1), np.stack([z, o, -x], -1), np.stack([-y, x, o], -1)], -2)


def _turned(axes: np.ndarray, v: np.ndarray) -> np.ndarray:
    return np.einsum("kij,kj->ki", axes, v)

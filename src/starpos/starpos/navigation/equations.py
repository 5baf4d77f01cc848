# SPDX-License-Identifier: Apache-2.0
"""The unknowns of a voyage, and their equations: from each node to the next, and of single nodes.

The mechanisation is strapdown, in ITRS: at each node inertial axes are laid along ITRS, in which the readings are summed;
until the next one ITRS turns with the Earth. There is no latitude or longitude in it, so that poles and 180 deg are like
other places.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from starpos.earth.gravity import SPIN, geodetic_place, gravity, gravity_gradient, zenith_at
from starpos.earth.orientation import ROTATION_RAD_S
from starpos.frozen import ArrayRows
from starpos.navigation.preintegration import ERRORS, Pieces, Sums, summed
from starpos.navigation.records import ImuModel, VelocityLog
from starpos.navigation.vessel import MotionLaw, Vessel
from starpos.rotation import cross_matrices, normalised
from starpos.units import SIGMA_PER_MAD

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
    camera_to_body (3, 3).  gyro_matrix, accel_matrix (3, 3): what readings are too large by, as shares.
    log_scale, log_axes (3,): of measured velocities, as a share and a small rotation.  lag_s, refraction: see the
    columns.
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


SPINNING = np.array([[0.0, -ROTATION_RAD_S, 0.0], [ROTATION_RAD_S, 0.0, 0.0], [0.0, 0.0, 0.0]])
# what may happen in the time of a missing reading: turns in rad/s, changes of speed in m/s2
LOST_RATE, LOST_FORCE = 1.0, 5.0
# a missing reading counts from this share of an interval on
LOST_SHARE = 1e-3


def arrived(motion: Motion, sums: Sums, span_s: np.ndarray) -> Motion:
    """The nodes after the first with place, velocity and attitude as the readings carry the ones before there."""
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
    return replace(
        motion.part(np.arange(1, len(motion))),
        place=_turned(back, place),
        velocity=_turned(back, inertial - np.cross(SPIN, place)),
        attitude=back @ attitude @ sums.turn,
    )


def sums_of(pieces: Pieces, motion: Motion) -> Sums:
    """Sums between the nodes of a motion, of readings that its errors are taken off."""
    return summed(
        pieces, motion.gyro_bias[:-1], motion.accel_bias[:-1], motion.gyro_matrix, motion.accel_matrix
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
    onward[:, PLACE, TURN] = -cross_matrices(way)
    onward[:, VELOCITY, PLACE] = SPINNING + pull * dt
    onward[:, VELOCITY, TURN] = -cross_matrices(speed)
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
    """Misclosures (K - 1, n): where each node arrives from the one before, minus the node."""
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
    tilting = -cross_matrices(force)
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


def _turned(axes: np.ndarray, v: np.ndarray) -> np.ndarray:
    return np.einsum("kij,kj->ki", axes, v)


# number of readings whose mean is the rate at a frame
RATE_READINGS = 5
# 1 sigma of the first node, of which nothing is known: place m, velocity m/s, attitude rad; of the measured velocity's
# scale (a share) and axes (rad an axis), and of the lag of the camera's stamps, s
NO_PLACE, NO_VELOCITY, NO_TURN = 2e7, 1e3, 10.0
SCALE_STDDEV, AXES_STDDEV, LAG_STDDEV_S = 0.01, 0.005, 0.005


@dataclass(frozen=True, eq=False, kw_only=True)
class StarAttitudes(ArrayRows):
    """Attitudes of the camera at F of the nodes: index (F,), camera_to_itrs (F, 3, 3), C into ITRS.

    covariance (F, 3, 3), by_refraction (F, 3); stamp_stddev_s (F,).
    rays (F, 3): the Sun in C, about which an attitude is not known; zeros for stars.
    """

    index: np.ndarray
    camera_to_itrs: np.ndarray
    covariance: np.ndarray
    by_refraction: np.ndarray
    stamp_stddev_s: np.ndarray
    rays: np.ndarray

    @property
    def whole(self) -> np.ndarray:
        """Mask (F,) of the attitudes that are known about every axis."""
        return np.asarray(~self.rays.any(1))

    def nearest(self, camera: np.ndarray) -> np.ndarray:
        """The attitudes (F, 3, 3), each turned about its ray so that it is nearest to the camera's (F, 3, 3)."""
        found, lone = self.camera_to_itrs.copy(), ~self.whole
        believed, seen = (_turned(axes[lone], self.rays[lone]) for axes in (camera, found))
        # the smallest turn that takes one to the other
        spin, cosine = cross_matrices(np.cross(believed, seen)), np.einsum("ki,ki->k", believed, seen)
        turn = np.eye(3) + spin + spin @ spin / np.maximum(1 + cosine, 1e-12)[:, None, None]
        found[lone] = turn @ camera[lone]
        return found


@dataclass(frozen=True, eq=False, kw_only=True)
class Residuals(ArrayRows):
    """Equations (F, 3, n + m + 1) of some nodes, index (F,), not whitened, and covariances (F, 3, 3) of their errors."""

    index: np.ndarray
    rows: np.ndarray
    covariance: np.ndarray

    def whitened(self, count: int) -> np.ndarray:
        """Equations (count, 3, n + m + 1) of all nodes, with zeros at nodes without one."""
        all_rows = np.zeros((count, *self.rows.shape[1:]))
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


def star_residuals(motion: Motion, stars: StarAttitudes, sums: Sums, pieces: Pieces, n: int) -> Residuals:
    """Equations of the frames with stars: the camera's attitude by the body's, the mount and the lag."""
    k = stars.index
    camera = motion.attitude[k] @ motion.camera_to_body
    off = Rotation.from_matrix(stars.nearest(camera).transpose(0, 2, 1) @ camera).as_rotvec()
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
    return Residuals(index=k, rows=rows, covariance=stars.covariance + smeared)


def _rates(sums: Sums, pieces: Pieces) -> np.ndarray:
    """Turn rates (K, 3) of the body at the nodes, rad/s."""
    here = (pieces.length_s > 0)[..., None]
    first = slice(0, RATE_READINGS)
    rate = (sums.rates * here)[:, first].sum(1) / np.maximum(here[:, first].sum(1), 1)
    return np.concatenate([rate, rate[-1:]])


def standing_residuals(motion: Motion, index: np.ndarray, sigma: float, n: int) -> Residuals:
    """Equations of nodes (F,) at which the vehicle stands, within sigma m/s."""
    covariance = np.tile(sigma**2 * np.eye(3), (len(index), 1, 1))
    return known_residuals(VELOCITY, -motion.velocity[index], index, covariance, n)


def known_residuals(
    columns: slice, off: np.ndarray, index: np.ndarray, covariance: np.ndarray, n: int
) -> Residuals:
    """Equations of nodes (F,) at which a vector, PLACE or VELOCITY, is known, and is off (F, 3) more than believed."""
    rows = np.zeros((len(index), 3, n + CONSTANTS + 1))
    rows[:, :, columns] = np.eye(3)
    rows[:, :, -1] = off
    return Residuals(index=index, rows=rows, covariance=covariance)


def law_residuals(motion: Motion, law: MotionLaw) -> Residuals:
    """Equations of the nodes whose velocity is known only from the motion law: speed along the nose, drift, rest."""
    up, count = zenith_at(motion.place), len(motion)
    level = np.eye(3) - up[:, :, None] * up[:, None, :]
    nose = normalised(np.einsum("kij,kj->ki", level, motion.attitude[:, :, 0]))
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
    covariance = law.longer(apart_s) ** 2 * (law.rest_stddev**2 * level + law.climb_stddev**2 * upward)
    return Residuals(index=np.arange(count), rows=rows, covariance=covariance)


def prior_rows(motion: Motion, model: ImuModel, vessel: Vessel, law: MotionLaw | None) -> np.ndarray:
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
    mount = Rotation.from_matrix(vessel.camera_to_body.T @ motion.camera_to_body).as_rotvec()
    for columns, spread, now in (
        (MOUNT, vessel.mount_stddev, mount),
        (GYRO_MATRIX, matrix, motion.gyro_matrix.ravel()),
        (ACCEL_MATRIX, matrix, motion.accel_matrix.ravel()),
        (LOG_SCALE, SCALE_STDDEV, motion.log_scale),
        (LOG_AXES, AXES_STDDEV, motion.log_axes),
        (LAG, LAG_STDDEV_S, motion.lag_s),
        (REFRACTION, max(vessel.atmosphere.relative_sigma, 1e-6), motion.refraction),
    ):
        sigma[n:][columns], value[n:][columns] = spread, now
    rows = np.zeros((n + CONSTANTS + 1, n + CONSTANTS + 1))
    rows[np.arange(n + CONSTANTS), np.arange(n + CONSTANTS)] = 1 / sigma
    rows[:-1, -1] = -value / sigma
    _, _, height = geodetic_place(motion.place[0])
    rows[-1, PLACE] = zenith_at(motion.place[0]) / vessel.height_stddev_m
    rows[-1, -1] = (vessel.height_m - float(height)) / vessel.height_stddev_m
    return rows


# velocities farther off come from a slipping wheel or another mishap
OUTLIER_SIGMA = 5.0


@dataclass(frozen=True, eq=False, kw_only=True)
class Odometry:
    """N velocities of a log that lie on a voyage: the interval (N,) and the node (N,) of each.

    offset_s (N,): since the interval's begin.  piece (N,): of the interval's readings.
    """

    velocity: np.ndarray
    sigma: np.ndarray
    interval: np.ndarray
    offset_s: np.ndarray
    piece: np.ndarray
    node: np.ndarray

    @classmethod
    def of(cls, log: VelocityLog, nodes: np.ndarray, pieces: Pieces) -> "Odometry":
        """Find where the velocities of a log lie among nodes (K,), Unix s."""
        on = (log.utc_unix_s >= nodes[0]) & (log.utc_unix_s <= nodes[-1])
        t = log.utc_unix_s[on]
        interval = np.clip(np.searchsorted(nodes, t, "right") - 1, 0, len(nodes) - 2)
        offset = t - nodes[interval]
        there = pieces.length_s > 0
        first = np.cumsum(there.sum(1)) - there.sum(1)
        begins = (pieces.begin_s + (nodes[:-1] - nodes[0])[:, None])[there]
        piece = np.searchsorted(begins, t - nodes[0], "right") - 1 - first[interval]
        return cls(
            velocity=log.velocity[on],
            sigma=log.sigma[on],
            interval=interval,
            offset_s=offset,
            piece=np.clip(piece, 0, there.shape[1] - 1),
            node=interval + (offset > pieces.span_s[interval] / 2),
        )

    def missed(self, motion: Motion, sums: Sums, pieces: Pieces) -> np.ndarray:
        """Measured less predicted velocities (N, 3), along the body's axes."""
        k, s = self.interval, self.piece
        since = (self.offset_s - pieces.begin_s[k, s])[:, None]
        turned = sums.turns[k, s] @ Rotation.from_rotvec(sums.rates[k, s] * since).as_matrix()
        force = pieces.force[k, s] - motion.accel_bias[k]
        speed = sums.speeds[k, s] + np.einsum("kij,kj->ki", turned, force) * since
        falling = gravity(motion.place[k]) - 2 * np.cross(SPIN, motion.velocity[k])
        velocity = np.einsum("kij,kj->ki", motion.attitude[k], speed) + falling * self.offset_s[:, None]
        attitude = motion.attitude[k] @ turned
        forward = np.einsum("kji,kj->ki", attitude, motion.velocity[k] + velocity - motion.drift[k])
        return self.velocity - (1 + motion.log_scale) * (forward + np.cross(motion.log_axes, forward))

    def totals(self, weight: np.ndarray, values: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Sums over the velocities near each of the nodes: of weights (N,), and of values (N, 3) times these."""
        columns = [weight, *(weight * part for part in values.T)]
        total, *parts = (np.bincount(self.node, column, count) for column in columns)
        return total, np.stack(parts, -1)

    def sound(self, missed: np.ndarray) -> np.ndarray:
        """Mask (N,) of the velocities within what most of them scatter on each axis, or should; missed (N, 3) m/s."""
        off = np.abs(missed) / self.sigma[:, None]
        usual = np.maximum(1.0, SIGMA_PER_MAD * np.median(off, axis=0))
        return (off < OUTLIER_SIGMA * usual).all(1)

    def residuals(
        self, motion: Motion, missed: np.ndarray, keep: np.ndarray, vibration: float, n: int
    ) -> Residuals:
        """Equations of the nodes near velocities to keep (N,); missed (N, 3): measured less predicted, m/s."""
        total, off = self.totals(keep / self.sigma**2, missed, len(motion))
        index = np.flatnonzero(total)
        sigma = np.hypot(1 / np.sqrt(total[index]), vibration)
        attitude = motion.attitude[index]
        through = motion.velocity[index] - motion.drift[index]
        forward = np.einsum("kji,kj->ki", attitude, through)
        rows = np.zeros((len(index), 3, n + CONSTANTS + 1))
        rows[:, :, VELOCITY] = attitude.transpose(0, 2, 1)
        rows[:, :, TURN] = attitude.transpose(0, 2, 1) @ cross_matrices(through)
        if n == BY_LAW:
            rows[:, :, DRIFT] = -attitude.transpose(0, 2, 1)
        constants = rows[:, :, n:-1]
        constants[:, :, LOG_SCALE] = forward[..., None]
        constants[:, :, LOG_AXES] = -cross_matrices(forward)
        rows[:, :, -1] = off[index] / total[index, None]
        return Residuals(index=index, rows=rows, covariance=(sigma**2)[:, None, None] * np.eye(3))

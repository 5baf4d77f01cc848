# SPDX-License-Identifier: Apache-2.0
"""Sums of an IMU's readings between nodes, in the body's axes at the first node, with their derivatives.

They hold wherever the body is and however it moves (Forster et al. 2017, IEEE Trans. Robot. 33, 1), so that an adjustment
need not go through the readings again for each place it tries; here they are for inertial axes, and so without the Earth.
"""

from dataclasses import dataclass
from functools import reduce

import numpy as np
from scipy.spatial.transform import Rotation

from starpos.navigation.records import GAP, ImuLog

# readings are joined to so long ones
READING_S = 0.02
# shorter pieces of a reading are the rounding of its stamp
SHORTEST_S = 1e-6
# gyro's or accelerometer's bias (3) and matrix (9), row-major
ERRORS = 12


@dataclass(frozen=True, eq=False, kw_only=True)
class Pieces:
    """Readings cut at nodes: K - 1 intervals of at most S pieces, those missing with a length of 0.

    gyro, force (K - 1, S, 3); length_s (K - 1, S); begin_s (K - 1, S): since the interval's begin.
    span_s (K - 1,): whole lengths of the intervals; missing_s (K - 1,): time without readings.
    """

    gyro: np.ndarray
    force: np.ndarray
    length_s: np.ndarray
    begin_s: np.ndarray
    span_s: np.ndarray
    missing_s: np.ndarray

    @classmethod
    def cut(cls, imu: ImuLog, nodes: np.ndarray) -> "Pieces":
        """Cut readings at the times of nodes (K,), Unix s, in order."""
        first, last = np.searchsorted(imu.utc_unix_s, nodes[[0, -1]])
        near = slice(min(first, len(imu.utc_unix_s) - 1), last + 1)
        end, zero = imu.utc_unix_s[near] - nodes[0], nodes - nodes[0]
        begin = end - imu.length_s[near]
        edges = np.unique(np.concatenate([begin, end, zero]))
        edges = edges[(edges >= 0) & (edges <= zero[-1])]
        edges = edges[np.append(True, np.diff(edges) > SHORTEST_S)]
        middle, length = (edges[1:] + edges[:-1]) / 2, np.diff(edges)
        # where a reading is missing the next one stands in
        sample = np.minimum(np.searchsorted(end, middle), len(end) - 1)
        missing = (begin[sample] > middle) | (end[sample] < middle)
        interval = np.searchsorted(zero, middle) - 1
        count = np.bincount(interval, minlength=len(nodes) - 1)
        place = np.arange(len(interval)) - np.repeat(np.cumsum(count) - count, count)
        shape = len(nodes) - 1, max(int(count.max(initial=0)), 1)

        def spread(values: np.ndarray) -> np.ndarray:
            table = np.zeros((*shape, *values.shape[1:]))
            table[interval, place] = values
            return table

        return cls(
            gyro=spread(imu.gyro[near][sample]),
            force=spread(imu.force[near][sample]),
            length_s=spread(length),
            begin_s=spread(middle - length / 2 - zero[interval]),
            span_s=np.diff(zero),
            missing_s=spread(length * missing).sum(1),
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class Sums:
    """What K - 1 intervals add up to, in the body's axes at each one's begin, which do not turn.

    turn (K - 1, 3, 3): the body's axes at the end; speed, way (K - 1, 3): sums of the force and of these, m/s and m.
    turn_slope (K - 1, 3, 12), speed_slope, way_slope (K - 1, 3, 24): by errors of the gyro; of gyro and accelerometer.
    turns (K - 1, S, 3, 3), speeds (K - 1, S, 3): the same until each piece's begin.
    rates (K - 1, S, 3): corrected turn rates, rad/s.
    """

    turn: np.ndarray
    speed: np.ndarray
    way: np.ndarray
    turn_slope: np.ndarray
    speed_slope: np.ndarray
    way_slope: np.ndarray
    turns: np.ndarray
    speeds: np.ndarray
    rates: np.ndarray


def summed(
    pieces: Pieces,
    gyro_bias: np.ndarray,
    accel_bias: np.ndarray,
    gyro_matrix: np.ndarray,
    accel_matrix: np.ndarray,
) -> Sums:
    """Sums of readings from which biases (K - 1, 3), then shares by matrices (3, 3), are taken off.

    Each piece turns about a steady axis, and its force acts at its middle.
    """
    rate = pieces.gyro - gyro_bias[:, None]
    rate = rate - rate @ gyro_matrix.T
    force = pieces.force - accel_bias[:, None]
    force = force - force @ accel_matrix.T
    length = pieces.length_s
    intervals, most = length.shape
    angle = rate * length[..., None]
    whole = Rotation.from_rotvec(angle.reshape(-1, 3)).as_matrix().reshape(intervals, most, 3, 3)
    half = Rotation.from_rotvec(angle.reshape(-1, 3) / 2).as_matrix().reshape(intervals, most, 3, 3)
    turn = np.tile(np.eye(3), (intervals, 1, 1))
    speed, way = np.zeros((2, intervals, 3))
    turns, speeds = np.empty((intervals, most, 3, 3)), np.empty((intervals, most, 3))
    turn_slope = np.zeros((intervals, 3, ERRORS))
    speed_slope, way_slope = np.zeros((2, intervals, 3, 2 * ERRORS))
    change = np.empty((intervals, 3, 2 * ERRORS))
    for k in range(most):
        turns[:, k], speeds[:, k] = turn, speed
        dt = length[:, k, None]
        middle = turn @ half[:, k]
        acting = np.einsum("kij,kj->ki", middle, force[:, k])
        turning = _by_errors(middle, rate[:, k])
        change[:, :, :ERRORS] = _crossed(acting, turn_slope + turning * (dt / 2)[..., None])
        change[:, :, ERRORS:] = _by_errors(middle, force[:, k])
        way += speed * dt + acting * dt**2 / 2
        speed = speed + acting * dt
        way_slope += speed_slope * dt[..., None] + change * (dt**2 / 2)[..., None]
        speed_slope += change * dt[..., None]
        turn_slope += turning * dt[..., None]
        turn = turn @ whole[:, k]
    return Sums(
        turn=turn,
        speed=speed,
        way=way,
        turn_slope=turn_slope,
        speed_slope=speed_slope,
        way_slope=way_slope,
        turns=turns,
        speeds=speeds,
        rates=rate,
    )


def turn_between(imu: ImuLog, begin_s: float, end_s: float) -> tuple[np.ndarray, float]:
    """The body's axes (3, 3) at a time in those at an earlier one, by the gyro alone, and the seconds without readings.

    Where a reading is missing the next one stands in, after the last one that.
    """
    pieces = Pieces.cut(imu, np.array([begin_s, end_s]))
    angle = pieces.gyro[0] * pieces.length_s[0, :, None]
    return reduce(np.matmul, Rotation.from_rotvec(angle).as_matrix()), float(pieces.missing_s[0])


def _by_errors(axes: np.ndarray, reading: np.ndarray) -> np.ndarray:
    """Change (K, 3, 12) of a reading (K, 3), seen along axes (K, 3, 3), by its bias and its matrix."""
    by_matrix = axes[..., None] * reading[:, None, None, :]
    return -np.concatenate([axes, by_matrix.reshape(len(axes), 3, 9)], -1)


def _crossed(force: np.ndarray, turned: np.ndarray) -> np.ndarray:
    """Change (K, 3, N) of forces (K, 3) where small turns (K, 3, N) act on them: turn x force."""
    x, y, z = force.T[:, :, None]
    a, b, c = np.moveaxis(turned, 1, 0)
    return np.stack([b * z - c * y, c * x - a * z, a * y - b * x], 1)


def thinned(imu: ImuLog) -> ImuLog:
    """Join readings that end within the same READING_S; the body turns by one of them as by its parts.

    A joined force is what its parts add up to, along the axes in the middle of the turn: coning and sculling of what is
    joined stay in it.  Readings on the two sides of a gap stay apart.
    """
    t, length = imu.utc_unix_s, imu.length_s
    apart = np.diff(t) > GAP * length[1:]
    new = np.append(True, (np.diff(np.ceil((t - t[0]) / READING_S - 1e-3)) != 0) | apart)
    group = np.cumsum(new) - 1
    count = np.bincount(group)
    if count.max() == 1:
        return imu
    first = np.flatnonzero(new)
    place = np.arange(len(t)) - first[group]
    turn = np.tile(np.eye(3), (len(count), 1, 1))
    push, whole_s = np.zeros((len(count), 3)), np.zeros(len(count))
    angle = imu.gyro * length[:, None]
    half, whole = (Rotation.from_rotvec(a).as_matrix() for a in (angle / 2, angle))
    for k in range(count.max()):
        rows = np.flatnonzero(place == k)
        into = group[rows]
        acting = np.einsum("kij,kj->ki", turn[into] @ half[rows], imu.force[rows])
        push[into] += acting * length[rows, None]
        turn[into] = turn[into] @ whole[rows]
        whole_s[into] += length[rows]
    turned = Rotation.from_matrix(turn).as_rotvec()
    middle = Rotation.from_rotvec(turned / 2)
    return ImuLog(
        utc_unix_s=t[np.append(first[1:], len(t)) - 1],
        length_s=whole_s,
        gyro=turned / whole_s[:, None],
        force=middle.inv().apply(push / whole_s[:, None]),
        faults=imu.faults,
    )

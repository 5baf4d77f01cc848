# SPDX-License-Identifier: Apache-2.0
"""Fewer inertial readings that say the same: neighbours become one, with what they turn and push in between."""

import numpy as np
from scipy.spatial.transform import Rotation

from starpos.navigation.imu import GAP, ImuLog


def thinned(imu: ImuLog, period_s: float) -> ImuLog:
    """Join readings that end within the same period; the body turns by one of them as by its parts.

    A joined force is what its parts add up to, along the axes in the middle of the turn: coning and sculling of what is
    joined stay in it.  Readings on the two sides of a gap stay apart.
    """
    t, length = imu.utc_unix_s, imu.length_s
    apart = np.diff(t) > GAP * length[1:]
    new = np.append(True, (np.diff(np.ceil((t - t[0]) / period_s - 1e-3)) != 0) | apart)
    group = np.cumsum(new) - 1
    count = np.bincount(group)
    if count.max() == 1:
        return imu
    first = np.flatnonzero(new)
    place = np.arange(len(t)) - first[group]
    turn, push, whole_s = (
        np.tile(np.eye(3), (len(count), 1, 1)),
        np.zeros((len(count), 3)),
        np.zeros(len(count)),
    )
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

# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from starpos.navigation.preintegration import Pieces, summed
from starpos.navigation.records import ImuLog

NONE, ZERO = np.zeros((3, 3)), np.zeros((1, 3))


def log(seconds=2.0, dt=0.01, gyro=(0.1, -0.2, 0.3), force=(1.0, 2.0, 9.0)):
    t = np.arange(1, round(seconds / dt) + 1) * dt
    return ImuLog.of(1e9 + t, np.tile(gyro, (len(t), 1)), np.tile(force, (len(t), 1)))


def test_a_steady_turn_has_a_closed_form():
    """A force that turns with the body: speed and way are integrals of Rodrigues' formula."""
    dt = 1.5
    sums = summed(Pieces.cut(log(dt=0.001), np.array([1e9, 1e9 + dt])), ZERO, ZERO, NONE, NONE)
    rate = np.array([0.1, -0.2, 0.3])
    w, f = np.linalg.norm(rate), np.array([1.0, 2.0, 9.0])
    axis = rate / w
    along, aside, across = axis * (axis @ f), f - axis * (axis @ f), np.cross(axis, f)
    speed = along * dt + aside * np.sin(w * dt) / w + across * (1 - np.cos(w * dt)) / w
    way = along * dt**2 / 2 + aside * (1 - np.cos(w * dt)) / w**2 + across * (w * dt - np.sin(w * dt)) / w**2
    assert sums.turn[0] == pytest.approx(Rotation.from_rotvec(rate * dt).as_matrix(), abs=1e-9)
    assert sums.speed[0] == pytest.approx(speed, abs=1e-6)
    assert sums.way[0] == pytest.approx(way, abs=1e-6)


def test_nodes_between_readings_cut_them():
    nodes = 1e9 + np.array([0.1034, 0.5, 0.7777, 1.2])
    pieces = Pieces.cut(log(), nodes)
    assert pieces.length_s.sum(1) == pytest.approx(np.diff(nodes), abs=3e-6)
    assert pieces.missing_s == pytest.approx(np.zeros(3), abs=3e-6)
    speed = summed(pieces, np.zeros((3, 3)), np.zeros((3, 3)), NONE, NONE)
    whole = summed(Pieces.cut(log(), nodes[[0, -1]]), ZERO, ZERO, NONE, NONE)
    chained = speed.turn[0] @ speed.turn[1] @ speed.turn[2]
    assert chained == pytest.approx(whole.turn[0], abs=1e-6)


def test_a_gap_is_told_and_bridged_by_the_next_reading():
    t = np.r_[np.arange(1, 101), np.arange(151, 301)] * 0.01
    imu = ImuLog.of(1e9 + t, np.zeros((len(t), 3)), np.tile([0.0, 0, 9.8], (len(t), 1)))
    assert "1 gaps, 0.50 s" in imu.faults[0]
    pieces = Pieces.cut(imu, 1e9 + np.array([0.0, 0.9, 1.7, 2.5]))
    assert pieces.missing_s == pytest.approx([0, 0.5, 0], abs=1e-5)
    sums = summed(pieces, np.zeros((3, 3)), np.zeros((3, 3)), NONE, NONE)
    assert sums.speed[1] == pytest.approx([0, 0, 9.8 * 0.8], abs=1e-4)


def test_slopes_are_those_of_differences(rng):
    t = np.arange(1, 201) * 0.01
    imu = ImuLog.of(1e9 + t, rng.normal(0, 0.5, (200, 3)), rng.normal([0, 0, 9.8], 3, (200, 3)))
    pieces = Pieces.cut(imu, 1e9 + np.array([0.0, 1.0, 2.0]))
    biases, matrices = rng.normal(0, 1e-3, (2, 2, 3)), rng.normal(0, 1e-4, (2, 3, 3))
    here = summed(pieces, *biases, *matrices)
    step = 1e-6
    for error in range(24):
        changed = [x.copy() for x in (*biases, *matrices)]
        kind, k = divmod(error, 12)
        if k < 3:
            changed[kind][:, k] += step
        else:
            changed[2 + kind].flat[k - 3] += step
        there = summed(pieces, *changed)
        assert (there.speed - here.speed) / step == pytest.approx(
            here.speed_slope[:, :, error], rel=0.01, abs=0.02
        )
        assert (there.way - here.way) / step == pytest.approx(here.way_slope[:, :, error], rel=0.01, abs=0.02)
        if kind == 0:
            turned = Rotation.from_matrix(there.turn @ here.turn.transpose(0, 2, 1)).as_rotvec()
            assert turned / step == pytest.approx(here.turn_slope[:, :, k], rel=0.01, abs=5e-3)

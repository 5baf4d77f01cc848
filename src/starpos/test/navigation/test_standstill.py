# SPDX-License-Identifier: Apache-2.0
"""Standstills of a rover without odometry: what is taken for one, and that a wrong one makes no claim."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from voyage_calls import navigated, nees, sigma_m, vessel

from starpos.navigation.chain import Chain, smoothed
from starpos.navigation.imu import ImuLog
from starpos.navigation.measures import Lacks, StarAttitudes
from starpos.navigation.motion import CONSTANTS, MEASURED, VELOCITY
from starpos.navigation.preintegration import Pieces
from starpos.navigation.standstill import Standstills, by_the_rest, standstills
from starpos_testing.halting import even, halting, idling, on_carriers
from starpos_testing.voyages import made

ARCSEC = np.pi / 648000
T = np.arange(0.0, 200.0, 2.0)
STANDS = (T >= 80) & (T <= 110)


def seen(turn, shaking, push=None):
    """Standstills of a body turned to `turn` (K, 3), rad, whose readings are shaken by `shaking` (K,), m/s2."""
    rng = np.random.default_rng(3)
    end = np.arange(0.02, T[-1] + 0.02, 0.02)
    noise = rng.normal(0, 1, (len(end), 3)) * np.interp(end, T, shaking)[:, None]
    force = noise + [0, 0, 9.8] + (0 if push is None else np.interp(end, T, push)[:, None] * [1, 0, 0])
    imu = ImuLog(
        utc_unix_s=1e9 + end, length_s=np.full(len(end), 0.02), gyro=np.zeros((len(end), 3)), force=force
    )
    errors = rng.normal(0, 1, (len(T), 3)) * [1.5, 1.5, 12.0] * ARCSEC
    stars = StarAttitudes(
        index=np.arange(len(T)),
        camera_to_itrs=(Rotation.from_rotvec(turn) * Rotation.from_rotvec(errors)).as_matrix(),
        covariance=np.tile(np.diag([1.5, 1.5, 12.0]) ** 2 * ARCSEC**2, (len(T), 1, 1)),
        by_refraction=np.zeros((len(T), 3)),
        stamp_stddev_s=np.zeros(len(T)),
    )
    return standstills(stars, Pieces.cut(imu, 1e9 + T))


TURN = np.outer(np.cumsum(np.where(STANDS, 0.0, 0.02)), [0.2, 0.1, 1.0])
SHAKING = np.where(STANDS, 0.003, 0.1)


def test_a_standstill_is_seen_from_where_the_shaking_ends_to_where_it_begins():
    found = seen(TURN, SHAKING)
    assert len(found) == 1
    assert 80 <= T[found.first[0]] <= 84 and 106 <= T[found.last[0]] <= 110
    assert found.links(len(T)).sum() == found.last[0] - found.first[0] == len(found.nodes) - 1


@pytest.mark.parametrize(
    "change",
    [
        {"turn": TURN + np.outer(np.where(STANDS, T - 80, 0.0), [1, 0, 0]) * ARCSEC},
        {"shaking": 0 * T + 0.1},
        {"shaking": 0 * T + 0.003},
        {"push": np.where(STANDS, 0.03 * np.sin(2 * np.pi * T / 20), 0.0)},
        {"turn": 0 * TURN},
    ],
    ids=["it pitches by 1 arcsec/s", "it shakes on", "motion is not felt", "it is pushed", "it never moves"],
)
def test_it_is_not_taken_to_stand_where(change):
    assert not len(seen(**{"turn": TURN, "shaking": SHAKING, **change}))


def test_what_the_rest_leads_to_is_a_solution_without_that_equation(rng):
    """Against solving again with it left out."""
    n, count, index = MEASURED, 6, np.array([1, 3, 4])
    size = n + CONSTANTS + 1
    rows = np.zeros((3, 3, size))
    rows[:, :, VELOCITY] = np.eye(3)
    rows[:, :, -1] = rng.normal(0, 0.1, (3, 3))
    trial = Lacks(index=index, rows=rows, covariance=np.tile(0.3**2 * np.eye(3), (3, 1, 1)))
    across = rng.normal(0, 0.1, (count - 1, n, 2 * n + CONSTANTS + 1))
    chain = Chain(
        first=np.column_stack([np.eye(size - 1), rng.normal(size=size - 1)]),
        nodes=trial.whitened(count),
        links=across + np.hstack([-np.eye(n), np.eye(n), np.zeros((n, CONSTANTS + 1))]),
        constants=CONSTANTS,
    )
    rest = by_the_rest(trial, 0.3, smoothed(chain))
    for j, k in enumerate(index):
        nodes = chain.nodes.copy()
        nodes[k] = 0.0
        without = smoothed(replace(chain, nodes=nodes))
        assert rest.velocity[j] == pytest.approx(without.nodes[k, VELOCITY] - rows[j, :, -1], abs=1e-6)
        assert rest.covariance[j] == pytest.approx(
            without.covariance[k, VELOCITY, VELOCITY], rel=1e-6, abs=1e-6
        )


def test_standstills_are_some_of_them_by_a_mask():
    both = Standstills(first=np.array([2, 9]), last=np.array([4, 9]))
    assert both.nodes.tolist() == [2, 3, 4, 9] and both.middle.tolist() == [3, 9]
    assert both.but(np.array([False, True])).nodes.tolist() == [9]


@pytest.mark.parametrize("vehicle", ["ship", "drone", "parked", None])
def test_only_a_rover_is_taken_to_stand(vehicle):
    assert vessel("rover").halts and not vessel(vehicle).halts


def driven(drive, seed=3):
    record = made("rover", 420, seed, rate_hz=25, cadence_s=2.0, drive=drive)
    return record, navigated(record, velocity=False)


STOPS = halting(driven_s=(40, 60), stood_s=(15, 25), sway=0.1)


def test_stops_narrow_the_claim_of_a_rover_without_odometry_and_it_holds():
    record, stopping = driven(STOPS)
    unseen_record, unseen = driven(idling(STOPS))
    assert nees(stopping, record) < 16 and nees(unseen, unseen_record) < 16
    assert sigma_m(stopping) < 0.7 * sigma_m(unseen)
    assert not stopping.faults or "stand" not in stopping.faults[-1]


@pytest.mark.parametrize(
    "drive",
    [even(leg_s=(20, 40), shaking_turns=True), on_carriers([0.2, 0.0, 0.0]), on_carriers([0.0, 0.0, 1.0])],
    ids=["even floor", "platforms", "lifts"],
)
def test_what_only_seems_to_stand_is_told_and_not_believed(drive):
    record, voyage = driven(drive)
    assert any("seems to stand" in fault for fault in voyage.faults)
    assert nees(voyage, record) < 16

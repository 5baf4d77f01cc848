# SPDX-License-Identifier: Apache-2.0
"""Standstills of a rover without odometry: what is taken for one, and that a wrong one makes no claim."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2
from voyage_calls import navigated, nees, sigma_m, vessel

from starpos.navigation.chain import Chain, smoothed
from starpos.navigation.equations import CONSTANTS, MEASURED, VELOCITY, Residuals, StarAttitudes
from starpos.navigation.evidence import NOWHERE, Standstills, by_the_rest, noise_density2, standstills
from starpos.navigation.preintegration import Pieces
from starpos.navigation.records import ImuLog
from starpos.navigation.voyage import Adjustment
from starpos_testing.halting import even, halting, idling, on_carriers
from starpos_testing.voyages import INDUSTRIAL, made

ARCSEC = np.pi / 648000
FINE = np.array([1.5, 1.5, 12.0]) * ARCSEC
T = np.arange(0.0, 200.0, 2.0)
STANDS = (T >= 80) & (T <= 110)


def seen(turn, shaking, push=None, **stars):
    """Standstills of a body turned to `turn` (K, 3), rad, whose readings are shaken by `shaking` (K,), m/s2."""
    return standstills(*recorded(turn, shaking, push, **stars))


def recorded(turn, shaking, push=None, t=T, sigma=FINE):
    """Stars and readings of it, at frames t (K,), s, that give the attitude to sigma (3,), rad."""
    rng = np.random.default_rng(3)
    end = np.arange(0.02, t[-1] + 0.02, 0.02)
    noise = rng.normal(0, 1, (len(end), 3)) * np.interp(end, t, shaking)[:, None]
    force = noise + [0, 0, 9.8] + (0 if push is None else np.interp(end, t, push)[:, None] * [1, 0, 0])
    imu = ImuLog(
        utc_unix_s=1e9 + end, length_s=np.full(len(end), 0.02), gyro=np.zeros((len(end), 3)), force=force
    )
    errors = rng.normal(0, 1, (len(t), 3)) * sigma
    stars = StarAttitudes(
        index=np.arange(len(t)),
        camera_to_itrs=(Rotation.from_rotvec(turn) * Rotation.from_rotvec(errors)).as_matrix(),
        covariance=np.tile(np.diag(sigma) ** 2, (len(t), 1, 1)),
        by_refraction=np.zeros((len(t), 3)),
        stamp_stddev_s=np.zeros(len(t)),
        rays=np.zeros((len(t), 3)),
    )
    return stars, Pieces.cut(imu, 1e9 + t)


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
        {"sigma": 10 * FINE},
    ],
    ids=[
        "it pitches by 1 arcsec/s",
        "it shakes on",
        "motion is not felt",
        "it is pushed",
        "it never moves",
        "stars are coarse",
    ],
)
def test_it_is_not_taken_to_stand_where(change):
    assert not len(seen(**{"turn": TURN, "shaking": SHAKING, **change}))


def test_a_record_of_half_a_second_shows_no_standstill():
    t = np.linspace(0, 0.5, 6)
    assert not len(seen(TURN[:6], SHAKING[:6], t=t))


def test_noise_at_rest_is_what_adds_up():
    """White readings of 0.003 m/s2 at 50 Hz; a fan of five times that between two readings adds nothing."""
    stars, pieces = recorded(TURN, SHAKING)
    standing = standstills(stars, pieces)
    density2 = noise_density2(pieces, standing)
    # of 13 intervals or so the scatter is known to a sixth
    assert density2 == pytest.approx(0.003**2 * 0.02, rel=0.6)
    fan = 0.015 * (-1) ** np.arange(pieces.force.shape[1])[:, None] * np.ones(3)
    fanned = replace(pieces, force=pieces.force + fan)
    assert noise_density2(fanned, standing) == pytest.approx(density2, rel=0.2)
    assert noise_density2(pieces, NOWHERE) == 0


def test_what_the_rest_leads_to_is_a_solution_without_that_equation(rng):
    """Against solving again with it left out."""
    n, count, index = MEASURED, 6, np.array([1, 3, 4])
    size = n + CONSTANTS + 1
    rows = np.zeros((3, 3, size))
    rows[:, :, VELOCITY] = np.eye(3)
    rows[:, :, -1] = rng.normal(0, 0.1, (3, 3))
    trial = Residuals(index=index, rows=rows, covariance=np.tile(0.3**2 * np.eye(3), (3, 1, 1)))
    across = rng.normal(0, 0.1, (count - 1, n, 2 * n + CONSTANTS + 1))
    chain = Chain(
        first=np.column_stack([np.eye(size - 1), rng.normal(size=size - 1)]),
        nodes=trial.whitened(count),
        links=across + np.hstack([-np.eye(n), np.eye(n), np.zeros((n, CONSTANTS + 1))]),
        constants=CONSTANTS,
    )
    velocity, covariance = by_the_rest(trial, 0.3, smoothed(chain))
    for j, k in enumerate(index):
        nodes = chain.nodes.copy()
        nodes[k] = 0.0
        without = smoothed(replace(chain, nodes=nodes))
        assert velocity[j] == pytest.approx(without.nodes[k, VELOCITY] - rows[j, :, -1], abs=1e-6)
        assert covariance[j] == pytest.approx(without.covariance[k, VELOCITY, VELOCITY], rel=1e-6, abs=1e-6)


def test_standstills_are_some_of_them_by_a_mask():
    both = Standstills(first=np.array([2, 9]), last=np.array([4, 9]))
    assert both.nodes.tolist() == [2, 3, 4, 9] and both.middle.tolist() == [3, 9]
    assert both.select(np.array([False, True])).nodes.tolist() == [9]


@pytest.mark.parametrize("vehicle", ["rover", "ship", "parked", None])
def test_only_a_rover_without_odometry_is_looked_at_for_standstills(vehicle):
    record = made("rover", 20, 3, rate_hz=25)
    nodes = record.frames_s
    for velocity in (None, record.velocity):
        adjustment = Adjustment(record.frames, nodes, record.imu, velocity, vessel(vehicle))
        assert adjustment.looked_for == (vehicle != "rover" or velocity is not None)


def driven(drive, seed=3, noisier=1.0):
    """A record and its voyage, with a multiple of the stated noise of the accelerometer."""
    model = replace(INDUSTRIAL, accelerometer_noise_density=noisier * INDUSTRIAL.accelerometer_noise_density)
    record = made("rover", 420, seed, rate_hz=25, cadence_s=2.0, drive=drive, model=model)
    return record, navigated(record, velocity=False)


def borne_out(scores):
    """Whether the sum of NEES, each 3 in the mean, lies between 0.1 % and 99.9 % of its chi-squared."""
    low, high = chi2.ppf([0.001, 0.999], 3 * len(scores))
    return low < sum(scores) < high


STOPS = halting(driven_s=(40, 60), stood_s=(15, 25), sway=0.1)


def test_stops_narrow_the_claim_of_a_rover_without_odometry_and_it_holds():
    scores, claims = [], []
    for seed in (3, 4):
        record, stopping = driven(STOPS, seed)
        scores.append(nees(stopping, record))
        claims.append(sigma_m(stopping))
        assert not stopping.faults or "stand" not in stopping.faults[-1]
    assert borne_out(scores), scores
    record, unseen = driven(idling(STOPS))
    assert borne_out([nees(unseen, record)]) and claims[0] < 0.7 * sigma_m(unseen)


def test_an_accelerometer_noisier_than_stated_is_told_by_standstills_and_the_claim_holds():
    record, noisy = driven(STOPS, 0, noisier=4.0)
    assert 3 < noisy.excess["forces at rest"] ** 0.5 < 5 and noisy.excess["forces"] < 64
    assert any("forces at rest scatter" in fault for fault in noisy.faults)
    assert borne_out([nees(noisy, record)])


@pytest.mark.parametrize(
    "drive",
    [even(leg_s=(20, 40), shaking_turns=True), on_carriers([0.2, 0.0, 0.0]), on_carriers([0.0, 0.0, 1.0])],
    ids=["even floor", "platforms", "lifts"],
)
def test_what_only_seems_to_stand_is_told_and_not_believed(drive):
    record, voyage = driven(drive)
    assert any("seems to stand" in fault for fault in voyage.faults)
    assert borne_out([nees(voyage, record)])

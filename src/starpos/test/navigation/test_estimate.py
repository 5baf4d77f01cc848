# SPDX-License-Identifier: Apache-2.0
"""An estimate that readings carry on: where it leads to, and that its claim grows with what is not known."""

from dataclasses import replace

import numpy as np
import pytest
from voyage_calls import vessel

from starpos.navigation.preintegration import Pieces, summed, thinned
from starpos.navigation.records import ImuLog
from starpos.navigation.voyage import adjust_voyage
from starpos_testing.voyages import made

END = 40


@pytest.fixture(scope="module")
def record():
    return made("rover", 60, 5, rate_hz=100)


@pytest.fixture(scope="module")
def last(record):
    """The estimate at a frame, of frames and velocities until then."""
    log, until_s = record.velocity, record.frames_s[END]
    on = log.utc_unix_s <= until_s
    log = replace(log, utc_unix_s=log.utc_unix_s[on], velocity=log.velocity[on], sigma=log.sigma[on])
    return adjust_voyage(record.frames[: END + 1], record.imu, log, vessel()).last


def moved_m(record, estimate, k):
    """How far the estimate has gone since frame END less the truth, (3,)."""
    return estimate.motion.place[0] - record.place[k]


def test_readings_carry_place_and_attitude_on_within_the_claim(record, last):
    there = last.carried_on(record.imu, record.frames_s[END + 15])
    drift = moved_m(record, there, END + 15) - moved_m(record, last, END)
    sigma = 15 * np.sqrt(np.trace(there.fix.velocity_covariance))
    assert np.linalg.norm(drift) < 3 * sigma
    turned = there.motion.attitude[0].T @ record.body_to_itrs[END + 15]
    assert np.arccos(min(1.0, (np.trace(turned) - 1) / 2)) < 4 * np.sqrt(np.trace(there.fix.link.covariance))


def test_the_way_does_not_depend_on_the_steps(record, last):
    whole = last.carried_on(record.imu, record.frames_s[END + 10])
    stepped = last
    for k in range(1, 21):
        stepped = stepped.carried_on(record.imu, record.frames_s[END] + k / 2)
    assert np.linalg.norm(whole.motion.place - stepped.motion.place) < 0.01
    assert np.trace(stepped.fix.velocity_covariance) == pytest.approx(
        np.trace(whole.fix.velocity_covariance), rel=0.01
    )


def test_what_is_missing_widens_the_claim(record, last):
    t = record.imu.utc_unix_s
    here = (t < record.frames_s[END] + 2) | (t > record.frames_s[END] + 4)
    gap = ImuLog.of(t[here], record.imu.gyro[here], record.imu.force[here])
    until_s = record.frames_s[END + 6]
    # 5 m/s2 may have acted for two seconds, and 1 rad/s have turned it
    assert np.sqrt(np.trace(last.carried_on(gap, until_s).fix.velocity_covariance)) > 10
    assert np.sqrt(np.trace(last.carried_on(record.imu, until_s).fix.velocity_covariance)) < 0.2


def test_noise_alone_widens_the_claim(record, last):
    """White noise of the gyro over 10 s, where all else is known."""
    sure = replace(last, covariance=np.zeros_like(last.covariance))
    there = sure.carried_on(record.imu, record.frames_s[END + 10])
    turn = last.model.gyroscope_noise_density * np.sqrt(10)
    assert np.sqrt(np.diag(there.fix.link.covariance)[:2]) == pytest.approx([turn, turn], rel=0.05)


def test_joined_readings_say_the_same():
    record = made("ship", 30, 2, rate_hz=400, errors=False)
    few = thinned(record.imu)
    assert few.length_s[1:-1] == pytest.approx(0.02, rel=1e-4)
    nodes, none = few.utc_unix_s[[0, 500, 1400]], np.zeros((2, 3))
    many, fewer = (
        summed(Pieces.cut(imu, nodes), none, none, np.zeros((3, 3)), np.zeros((3, 3)))
        for imu in (record.imu, few)
    )
    assert np.abs(many.turn - fewer.turn).max() < 1e-9
    # 0.1 mm/s in 18 s is 4 m of place
    assert np.abs(many.speed - fewer.speed).max() < 1e-4


def test_readings_on_the_two_sides_of_a_gap_stay_apart(record):
    t = record.imu.utc_unix_s
    keep = (t < t[1001]) | (t > t[1203])
    log = ImuLog.of(t[keep], record.imu.gyro[keep], record.imu.force[keep])
    few = thinned(log)
    assert few.length_s.sum() == pytest.approx(log.length_s.sum())
    begin = few.utc_unix_s - few.length_s
    assert (begin[1:] - few.utc_unix_s[:-1]).max() == pytest.approx(2.02, abs=0.011)

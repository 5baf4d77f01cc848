# SPDX-License-Identifier: Apache-2.0
"""Accelerations in any order, doubled, broken, at any rate: each is counted once, and what comes out is a tilt."""

import math
from types import SimpleNamespace

import numpy as np
import pytest

from starpos.messages.stamp import PlainHeader, PlainStamp
from starpos.messages.tilt import FUTURE_S, GAP, STUCK, ImuTilts, message_to_tilt
from starpos.parameters.given import values_of
from starpos.units import STANDARD_GRAVITY

BEGIN_NS, PERIOD_NS = 1_700_000_000 * 10**9, 10**7
NOISE = 0.02
UP = np.array([0.03, 0.02, math.sqrt(1 - 0.03**2 - 0.02**2)])
VALUES = values_of("inclinometer", None, ())


def message(stamp_ns, force, turning=0.0):
    x, y, z = map(float, force)
    return SimpleNamespace(
        header=PlainHeader(PlainStamp.of_ns(stamp_ns), "imu"),
        linear_acceleration=SimpleNamespace(x=x, y=y, z=z),
        angular_velocity=SimpleNamespace(x=0.0, y=0.0, z=turning),
        angular_velocity_covariance=[0.0] * 9,
        linear_acceleration_covariance=[0.0] * 9,
    )


class Received:
    """The tilts of messages, as they come: their stamps in periods, their forces."""

    def __init__(self, stamps, forces, now_ns=10**19, **values):
        self.imu, self.readings = ImuTilts(VALUES | values), []
        for stamp, force in zip(stamps, forces, strict=True):
            reading = self.imu.receive(message(BEGIN_NS + round(stamp * PERIOD_NS), force), now_ns)
            if reading is not None:
                self.readings.append(reading)
        self.tilts = [message_to_tilt(reading) for reading in self.readings]

    def pulls(self, up=UP):
        """Errors of x and y in sigma, of the tilts that follow the first few, whose noise is not known yet."""
        true = np.arcsin(up[:2])
        return np.array([(t.theta[:2] - true) / np.sqrt(np.diag(t.covariance)) for t in self.tilts[8:]])


def noisy(rng, count, each=1, up=UP):
    """Forces with noise, of which each is published several times."""
    return np.repeat(STANDARD_GRAVITY * up + rng.normal(0, NOISE, (count // each + 1, 3)), each, axis=0)[
        :count
    ]


@pytest.mark.parametrize("each", [1, 2, 8])
@pytest.mark.parametrize(
    "up", [UP, UP * [1, 1, -1], [math.sqrt(1 - 2e-4), 0.01, 0.01]], ids=["stands", "hangs", "lies"]
)
def test_the_claim_of_a_tilt_is_its_scatter_however_often_a_value_is_published(rng, each, up):
    up = np.array(up)
    got = Received(range(6000), noisy(rng, 6000, each, up))
    assert len(got.tilts) == 119 and {r.flags for r in got.readings} == {0}
    # near the vertical an angle's error is no sigma
    axes = np.abs(up[:2]) < 0.9
    assert 0.5 < np.sqrt(np.square(got.pulls(up)[:, axes]).mean()) < 1.3


@pytest.mark.parametrize("seed", range(6))
def test_each_message_is_counted_and_stamps_never_go_back(seed):
    """Swapped, doubled and lost messages, NaN among them, a clock that is set twice, stamps from the future."""
    rng = np.random.default_rng(seed)
    stamps = np.arange(3000.0) + rng.integers(-4, 5, 3000) * (rng.random(3000) < 0.1)
    stamps[1000:] += rng.choice([-2000.0, 500.0, 1e5])
    stamps = np.repeat(stamps, rng.choice([0, 1, 1, 1, 2], 3000))
    forces = noisy(rng, len(stamps))
    broken = rng.random(len(stamps)) < 0.05
    forces[broken, rng.integers(0, 3, broken.sum())] = rng.choice([np.nan, np.inf, -np.inf], broken.sum())
    future = rng.random(len(stamps)) < 0.02
    stamps = np.where(future, 1e9, stamps)
    now_ns = BEGIN_NS + round(2e5 * PERIOD_NS + FUTURE_S * 1e9)
    got = Received(stamps, forces, now_ns)
    imu = got.imu
    assert (imu.malformed, imu.future) == (broken.sum(), (future & ~broken).sum())
    assert imu.good + imu.malformed + imu.future == len(stamps)
    assert len(got.tilts) > 20 and np.abs(got.pulls()).max() < 6
    sequence = np.diff([r.sequence for r in got.readings])
    assert (sequence >= 1).all()
    # nothing between two tilts is silent: a time that is set, and a sequence that was interrupted, are flagged
    steps_s = np.diff([r.stamp_ns for r in got.readings]) * 1e-9
    later = [r.flags & GAP for r in got.readings[1:]]
    assert all(flag or 0 < step < 2 for flag, step in zip(later, steps_s, strict=True))


@pytest.mark.parametrize(
    ("forces", "unrest"),
    [
        (np.zeros(3), "0 m/s2"),
        (1.1 * STANDARD_GRAVITY * UP, "10.8 m/s2"),
        (-0.9 * STANDARD_GRAVITY * UP, "8.83 m/s2"),
    ],
)
def test_what_is_no_gravity_gives_no_tilt_and_says_what_it_feels(forces, unrest):
    got = Received(range(300), np.tile(forces, (300, 1)))
    assert not got.tilts and unrest in got.imu.unrest


def test_too_few_messages_or_one_time_give_no_tilt(rng):
    for stamps in (np.arange(300) * 100.0, np.arange(300) * 30.0, np.zeros(300), np.arange(300) % 2 * 1e4):
        assert not Received(stamps, noisy(rng, 300)).tilts


def test_a_sensor_that_stops_is_stuck_and_one_that_never_had_noise_is_not(rng):
    forces = noisy(rng, 3000)
    stops = forces.copy()
    stops[2000:] = stops[2000]
    assert {r.flags for r in Received(range(3000), stops).readings[-10:]} == {STUCK}
    assert {r.flags for r in Received(range(3000), np.tile(UP * STANDARD_GRAVITY, (3000, 1))).readings} == {0}


def test_another_sensor_begins_a_sequence_with_noise_of_its_own(rng):
    got = Received(range(3000), noisy(rng, 3000))
    got.imu.restart()
    assert got.imu.noise is None
    after = [
        got.imu.receive(message(BEGIN_NS + (3000 + k) * PERIOD_NS, UP * STANDARD_GRAVITY), 10**19)
        for k in range(200)
    ]
    readings = [r for r in after if r is not None]
    assert readings[0].flags == GAP and {r.flags for r in readings[1:]} == {0}

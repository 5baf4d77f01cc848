# SPDX-License-Identifier: Apache-2.0
"""The gyro's prediction: right where readings support it, none where they do not, and never a wrong answer."""

from dataclasses import replace

import numpy as np
import pytest
from imu_readings import reading
from scipy.spatial.transform import Rotation

from starpos.fix.solution import Status
from starpos.session.driver import Now
from starpos.session.gyro import Gyro
from starpos.session.gyro_readings import GyroReadings
from starpos_testing.skies.scenes import (
    EXPOSURE,
    SIZE,
    START,
    random_stars,
    solver_of,
    stars_of,
    wide_scene,
    with_false_stars,
)

LIVE = Now(None, 0.0)
# 8 deg/s, and twice as fast at once
RATE = np.array([0.05, -0.08, 0.1])
MID_S = START + EXPOSURE / 2


class Said(list):
    """Keeps the sentences of what is refused."""

    def came(self, name):
        pass

    def refuse(self, name, sentence):
        self.append(sentence)


def tell(gyro, begin_s, end_s, rate=RATE, rate_hz=100, now=LIVE):
    """Readings of a time: of a steady rate (3,), or of one that is a function of the time."""
    for t in np.arange(begin_s + 1 / rate_hz, end_s + 0.5 / rate_hz, 1 / rate_hz):
        gyro.receive(reading(t, rate(t) if callable(rate) else rate), now)


@pytest.fixture(scope="module")
def scene():
    return wide_scene()


@pytest.fixture(scope="module")
def solver(scene, catalogue):
    return solver_of(scene, catalogue)


@pytest.fixture
def first(scene, catalogue, solver, rng):
    """A frame and the attitude from its stars."""
    stars = stars_of(scene, catalogue, rng)
    return stars, solver.identify(stars).found


@pytest.fixture
def said():
    return Said()


@pytest.fixture
def gyro(said, first, solver):
    """One that has seen the frame, after readings of a second."""
    gyro = Gyro(said)
    tell(gyro, MID_S - 1.0, MID_S)
    gyro.learn_from(*first, solver)
    return gyro


def frame_at(stars, since_s):
    return replace(stars, mid_unix_s=MID_S + since_s)


def turned(attitude, solver, rate, since_s):
    """An attitude (3, 3) after the body has turned at a steady rate."""
    link = np.asarray(solver.instrument.link_to_camera)
    return Rotation.from_rotvec(-link @ np.asarray(rate) * since_s).as_matrix() @ attitude


def off_rad(prior, attitude):
    return Rotation.from_matrix(prior.attitude @ attitude.T).magnitude()


def test_readings_turn_the_attitude_on(gyro, first, solver):
    stars, found = first
    tell(gyro, MID_S, MID_S + 0.4)
    (prior,) = gyro.predicted(frame_at(stars, 0.3567), solver)
    assert off_rad(prior, turned(found.attitude, solver, RATE, 0.3567)) < 1e-6
    assert prior.focal_px == pytest.approx(4636, rel=1e-3)


def test_a_turn_to_the_left_by_the_sky_is_one_by_the_gyro(said, catalogue, rng):
    """A camera that looks up, the top of whose frame turns from azimuth 40 to 36 deg."""
    before, after = (wide_scene(pointing_deg=(azimuth_deg, 89.99, 0.0)) for azimuth_deg in (40.0, 36.0))
    solver, gyro = solver_of(before, catalogue), Gyro(said)
    stars = stars_of(before, catalogue, rng)
    gyro.learn_from(stars, solver.identify(stars).found, solver)
    tell(gyro, MID_S - 0.01, MID_S + 0.2, (0.0, 0.0, np.radians(20.0)))
    later = stars_of(after, catalogue, rng, START + 0.2)
    assert off_rad(gyro.predicted(later, solver)[0], solver.identify(later).found.attitude) < 1e-3


def test_the_last_rate_holds_for_a_tenth_of_a_second(gyro, first, solver):
    stars, found = first
    tell(gyro, MID_S, MID_S + 0.3)
    (prior,) = gyro.predicted(frame_at(stars, 0.39), solver)
    assert off_rad(prior, turned(found.attitude, solver, RATE, 0.39)) < 1e-6
    assert not gyro.predicted(frame_at(stars, 0.41), solver)


def test_a_gap_or_a_time_before_the_readings_gives_none(said, gyro, first, solver):
    tell(gyro, MID_S, MID_S + 0.1)
    tell(gyro, MID_S + 0.25, MID_S + 0.4)
    assert not gyro.predicted(frame_at(first[0], 0.4), solver)
    late = Gyro(said)
    late.learn_from(*first, solver)
    tell(late, MID_S + 0.2, MID_S + 0.4)
    assert not late.predicted(frame_at(first[0], 0.4), solver)
    assert not gyro.predicted(frame_at(first[0], -0.1), solver)


@pytest.mark.parametrize(("largest", "is_told"), [(2.0, False), (9.0, True)])
def test_clipped_readings_tell_no_turn(largest, is_told):
    readings = GyroReadings()
    for t in np.arange(0.01, 1.0, 0.01):
        rate = np.clip(5.0 * np.sin(8.0 * t), -largest, largest)
        readings.receive(reading(START + t, (0.0, 0.0, rate)))
    turn = readings.turn(START + 0.1, START + 0.9, 0.0, np.zeros(3))
    assert (turn is not None) == is_told


@pytest.mark.parametrize("rate", [(np.nan, 0, 0), (0, np.inf, 0), (0, 0, 1e6)])
def test_what_is_no_rate_is_told_and_left_out(gyro, said, first, solver, rate):
    tell(gyro, MID_S, MID_S + 0.2)
    gyro.receive(reading(MID_S + 0.205, rate), LIVE)
    tell(gyro, MID_S + 0.2, MID_S + 0.4)
    assert ["NaN" in sentence for sentence in said] == [True]
    assert gyro.predicted(frame_at(first[0], 0.4), solver)


def test_who_measures_no_rate_and_who_has_no_time_is_told(gyro, said):
    gyro.receive(reading(MID_S + 0.1, RATE, measured=False), LIVE)
    gyro.receive(reading(0.0, RATE), LIVE)
    assert "measures no rates" in said[0] and "no time stamp" in said[1]


def test_a_clock_that_is_set_back_begins_anew(gyro, said, first, solver):
    gyro.receive(reading(MID_S + 3600.0, RATE), LIVE)
    tell(gyro, MID_S - 0.1, MID_S + 0.4)
    assert gyro.predicted(frame_at(first[0], 0.4), solver) and not said


def test_recorded_data_have_none(said, first, solver):
    gyro = Gyro(said)
    tell(gyro, MID_S - 1.0, MID_S + 0.4, now=Now.in_data(MID_S))
    gyro.learn_from(*first, solver)
    assert not gyro.predicted(frame_at(first[0], 0.4), solver)


def test_an_old_attitude_is_of_no_use_until_the_bias_is_known(gyro, first, solver, said):
    stars, found = first
    bias = np.array([0.01, 0.02, -0.015])
    tell(gyro, MID_S, MID_S + 2.0, RATE + bias)
    later = frame_at(stars, 1.0)
    assert not gyro.predicted(later, solver)
    seen = found.but(attitude=turned(found.attitude, solver, RATE, 1.0))
    gyro.learn_from(later, seen, solver)
    (prior,) = gyro.predicted(frame_at(stars, 2.0), solver)
    assert off_rad(prior, turned(found.attitude, solver, RATE, 2.0)) < 3e-3 and not said
    tell(gyro, MID_S + 2.0, MID_S + 30.0)
    assert not gyro.predicted(frame_at(stars, 30.0), solver)


WRONG = {"in deg/s": np.degrees, "axes exchanged": lambda w: w[[1, 2, 0]], "of the other sign": lambda w: -w}


@pytest.mark.parametrize("kind", WRONG)
def test_a_gyro_that_contradicts_the_stars_is_told(said, first, solver, kind):
    stars, found = first
    gyro = Gyro(said)
    tell(gyro, MID_S - 0.1, MID_S + 1.0, WRONG[kind](RATE))
    gyro.learn_from(stars, found, solver)
    later = found.but(attitude=turned(found.attitude, solver, RATE, 1.0))
    gyro.learn_from(frame_at(stars, 1.0), later, solver)
    assert ["off the stars" in sentence for sentence in said] == [True]


def few(stars, rng):
    """Four of a frame's brightest stars under four false ones that are brighter."""
    rows = np.sort(rng.choice(12, 4, replace=False))
    return with_false_stars(stars.select(rows), rng.uniform(20, np.array(SIZE) - 20, (4, 2)))


@pytest.mark.montecarlo
def test_few_stars_of_a_turning_camera_are_identified_with_the_gyro_and_not_without(said, catalogue, rng):
    """Ten times, 5 deg in 0.5 s of a camera that looks up; the gyro is a cheap one, with a bias of 0.5 deg/s."""
    found = lost = 0
    for k in range(10):
        scenes = [wide_scene(pointing_deg=(36.0 * k - 5.0 * n, 89.99, 0.0)) for n in range(3)]
        start, solver, gyro = START + 600.0 * k, solver_of(scenes[0], catalogue), Gyro(said)
        frames = [stars_of(scene, catalogue, rng, start + 0.5 * n) for n, scene in enumerate(scenes)]
        rate = np.array([0.0, 0.0, np.radians(10.0)]) + rng.normal(0, 0.005, 3)
        tell(gyro, start, start + 1.5, lambda t, rate=rate: rate + rng.normal(0, 0.002, 3))
        for stars in frames[:2]:
            gyro.learn_from(stars, solver.identify(stars).found, solver)
        truth, stars = solver.identify(frames[2]).found, few(frames[2], rng)
        lost += solver.identify(stars).found is not None
        answer = solver.identify(stars, gyro.predicted(stars, solver))
        if answer.ok:
            found += 1
            # a false star near the place of a true one turns four of them by some px about the axis
            assert Rotation.from_matrix(answer.found.attitude @ truth.attitude.T).magnitude() < 3e-3
            assert not answer.warnings
    assert lost <= 2 and found >= 9


@pytest.mark.montecarlo
def test_random_points_stay_nothing_whatever_the_gyro_says(gyro, first, solver, rng):
    tell(gyro, MID_S, MID_S + 0.4)
    for n in range(200):
        stars = random_stars(4 + n % 20, rng, mid_unix_s=MID_S + 0.4)
        answer = solver.identify(stars, gyro.predicted(stars, solver))
        assert answer.found is None and answer.status is Status.NOT_IDENTIFIED


@pytest.mark.parametrize("kind", WRONG)
def test_a_wrong_gyro_costs_no_answer(said, first, solver, catalogue, rng, kind):
    stars, found = first
    gyro = Gyro(said)
    tell(gyro, MID_S - 0.1, MID_S + 0.1, WRONG[kind](RATE))
    gyro.learn_from(stars, found, solver)
    later = frame_at(stars, 0.1)
    # the camera has stood
    wrong = gyro.predicted(later, solver)
    answer = solver.identify(later, wrong)
    assert kind == "in deg/s" or off_rad(wrong[0], found.attitude) > 0.005
    np.testing.assert_array_equal(answer.found.catalogue, solver.identify(later).found.catalogue)

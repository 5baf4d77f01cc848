# SPDX-License-Identifier: Apache-2.0
"""Tilts matched to exposures by their time stamps, whatever order and state they come in."""

import math
from types import SimpleNamespace

import numpy as np
import pytest

from starpos.errors import TiltError, TiltRangeError
from starpos.instrument import sensors
from starpos.instrument.inclinometer import InclinometerErrors
from starpos.messages.tilt import OUT_OF_RANGE, SATURATED, STUCK
from starpos.session.tilts import CAPACITY, TiltBuffer

NOISE = math.radians(0.0035)
GAP = 8
T0 = 1_793_642_400.0


def sample(
    seconds: float,
    x_deg: float = 1.0,
    y_deg: float = -2.0,
    flags: int = 0,
    variance: float = 0.0,
    z_variance: float = 0.0,
) -> SimpleNamespace:
    """A message as rclpy or rosbags gives it."""
    whole, part = divmod(round((T0 + seconds) * 1e6), 1_000_000)
    header = SimpleNamespace(stamp=SimpleNamespace(sec=whole, nanosec=part * 1000), frame_id="")
    return SimpleNamespace(
        header=header,
        x=math.radians(x_deg),
        y=math.radians(y_deg),
        z=math.acos(math.hypot(math.sin(math.radians(x_deg)), math.sin(math.radians(y_deg))))
        if z_variance
        else 0.0,
        z_variance=z_variance,
        covariance=[variance, 0.0, 0.0, variance],
        temperature=10.0,
        flags=flags,
    )


def new_buffer() -> TiltBuffer:
    return TiltBuffer(SimpleNamespace(tilt_stddev_rad=NOISE, values={"tilt_window": 0.5}))


def buffer_of(messages) -> TiltBuffer:
    buffer = new_buffer()
    for message in messages:
        buffer.keep(message)
    return buffer


def test_the_average_takes_the_exposures_samples_only_in_any_order():
    inside = [sample(k / 10, 1 + k * 0.002) for k in range(-2, 3)]
    outside = [sample(k / 10, 20.0) for k in (-5, -4, 4, 5)]
    messages = inside + outside
    np.random.default_rng(1).shuffle(messages)
    tilt = buffer_of(messages).average(T0, 0.5)
    assert tilt.samples == 5
    assert tilt.theta_x == pytest.approx(math.radians(1.0), abs=1e-9)
    assert tilt.theta_y == pytest.approx(math.radians(-2.0), abs=1e-12)


def test_an_unknown_covariance_becomes_the_parameters_and_averages_down():
    tilt = buffer_of(sample(k / 10) for k in range(-2, 3)).average(T0, 0.5)
    assert tilt.covariance == pytest.approx(np.eye(2) * NOISE**2 / 5)


def test_a_stated_covariance_is_used():
    tilt = buffer_of(sample(k / 10, variance=1e-8) for k in range(-2, 3)).average(T0, 0.5)
    assert tilt.covariance == pytest.approx(np.eye(2) * 1e-8 / 5)


def test_the_noise_is_measured_from_all_samples_so_far():
    """Five show little; samples after the exposure are there by chance and do not count."""
    rng = np.random.default_rng(3)
    noisy = [
        sample(-60 + k / 10, *([1, -2] + 3 * np.degrees(NOISE) * rng.normal(size=2))) for k in range(603)
    ]
    found = math.sqrt(buffer_of(noisy).average(T0, 0.5).covariance[0, 0] * 5)
    assert found == pytest.approx(3 * NOISE, rel=0.15)
    later = [
        sample(0.3 + k / 10, *([1, -2] + 9 * np.degrees(NOISE) * rng.normal(size=2))) for k in range(300)
    ]
    assert buffer_of(noisy + later).average(T0, 0.5).covariance[0, 0] * 5 == pytest.approx(found**2)


def test_samples_that_come_again_and_again_tell_the_noise_once():
    apart = 2.5 * np.degrees(NOISE)
    five = [sample(k / 10, 1.0 + apart * (k % 2)) for k in range(-2, 3)]
    once = buffer_of(five).average(T0, 0.5).covariance
    assert buffer_of(10 * five).average(T0, 0.5).covariance == pytest.approx(once, rel=1e-12)


@pytest.mark.parametrize("often", [1, 3, 12])
def test_readings_that_are_published_several_times_count_once(often, rng):
    x, y = (6 + rng.normal(0, 0.0035, (2, 40))).repeat(often, 1).tolist()
    buffer = buffer_of(sample(k / 100, x[k], y[k]) for k in range(len(x)))
    tilt = buffer.average(T0 + 0.2 * often, 0.2 * often)
    assert tilt.samples == pytest.approx(20, abs=1)
    assert tilt.step_rad == 0


def test_a_cleared_buffer_measures_the_noise_as_a_new_one():
    rng = np.random.default_rng(5)
    noisy = [sample(-6 + k / 10, *([1, -2] + 4 * np.degrees(NOISE) * rng.normal(size=2))) for k in range(63)]
    buffer = buffer_of([*noisy, sample(60.0)])
    buffer.clear()
    for message in noisy:
        buffer.keep(message)
    assert np.array_equal(buffer.average(T0, 0.5).covariance, buffer_of(noisy).average(T0, 0.5).covariance)


def test_a_night_that_is_played_again_measures_the_same_noise():
    """Three exposures of few samples show nothing; with both times counted they showed noise that is not there."""
    rng = np.random.default_rng(5)
    buffer, shots = new_buffer(), [0.0, 3.0, 6.0]
    night = [
        [sample(t + k / 10, *([1, -2] + 2.5 * np.degrees(NOISE) * rng.normal(size=2))) for k in range(-2, 3)]
        for t in shots
    ]

    def played():
        for t, messages in zip(shots, night, strict=True):
            for message in messages:
                buffer.keep(message)
            yield buffer.average(T0 + t, 0.5).covariance

    first = list(played())
    assert np.array_equal(list(played()), first)
    assert np.array_equal(list(played()), first)


def test_samples_from_before_the_clock_was_set_back_are_none_of_the_same_times_now():
    before = [sample(k / 10, 20.0) for k in range(-20, 300)]
    buffer = buffer_of([*before, *(sample(k / 10 + 0.03) for k in range(-3, 4))])
    tilt = buffer.average(T0, 0.5)
    assert (tilt.samples, tilt.theta_x) == (5, pytest.approx(math.radians(1.0)))


def test_samples_of_a_later_time_than_those_that_come_after_them_are_of_a_wrong_clock():
    """They lie in a later exposure, whose own samples are lost; without the rule it was a fix 541 km off."""
    ahead = [sample(2.4 + k / 10, 20.0) for k in range(-2, 3)]
    buffer = buffer_of([*ahead, *(sample(0.8 + k / 10) for k in range(-2, 3))])
    with pytest.raises(TiltError, match=r"no tilt reading in the exposure"):
        buffer.average(T0 + 2.4, 0.5)
    assert buffer.average(T0 + 0.8, 0.5).samples == 5


def test_samples_of_a_clock_that_was_ahead_are_forgotten_when_it_is_right():
    buffer = buffer_of([sample(100 + k / 10, 20.0) for k in range(-2, 3)] + [sample(0.0)])
    buffer.forget_after(T0 + 1.0)
    assert len(buffer) == 1 and not buffer.complete(T0 + 100.0, 0.5)
    with pytest.raises(TiltError, match="no sample near"):
        buffer.average(T0 + 100.0, 0.5)


def test_a_gap_before_a_sample_does_not_spoil_it():
    assert buffer_of([sample(0.0, flags=GAP)]).average(T0, 0.5).samples == 1


@pytest.mark.parametrize("flag", [OUT_OF_RANGE, SATURATED])
def test_flagged_samples_explain_a_missing_tilt(flag):
    with pytest.raises(TiltRangeError, match="beyond its range"):
        buffer_of([sample(0.0, flags=flag)]).average(T0, 0.5)


def test_a_stuck_converter_is_named():
    with pytest.raises(TiltError, match="same value"):
        buffer_of([sample(0.0, flags=STUCK)]).average(T0, 0.5)


def test_nothing_near_says_how_far_the_nearest_is():
    with pytest.raises(TiltError, match=r"60\.0 s off"):
        buffer_of([sample(60.0)]).average(T0, 0.5)
    with pytest.raises(TiltError, match="none has arrived"):
        new_buffer().average(T0, 0.5)


def test_broken_samples_are_refused_and_not_kept():
    buffer = new_buffer()
    impossible = sample(0.0, 60.0, 60.0)
    for broken in (sample(0.0, math.nan), sample(0.0, variance=-1.0), sample(-T0), impossible):
        with pytest.raises(TiltError):
            buffer.keep(broken)
    assert len(buffer) == 0


def test_complete_once_a_sample_of_the_exposures_end_is_here():
    buffer = buffer_of(sample(k / 10) for k in range(-5, 1))
    assert not buffer.complete(T0, 0.5)
    buffer.keep(sample(0.2))
    assert buffer.complete(T0, 0.5)


def test_the_sample_after_an_exposure_is_waited_for_where_the_last_one_in_it_leaves_its_end_open():
    buffer = buffer_of(sample(k - 0.2) for k in range(-3, 1))
    assert not buffer.complete(T0, 0.5)
    buffer.keep(sample(0.8, 5.0))
    assert buffer.complete(T0, 0.5)
    with pytest.raises(TiltError, match="uncovered"):
        buffer.average(T0, 0.5)


def test_days_of_samples_stay_bounded():
    buffer = buffer_of(sample(k / 10) for k in range(CAPACITY + 500))
    assert len(buffer) == CAPACITY


BMI088, ADIS16209 = (sensors.find(model)[1] for model in ("bmi088", "adis16209"))
LEVEL = InclinometerErrors()


def judged(readings, errors, period_s=0.1, axes=3):
    """The tilt of an exposure at T0 that an inclinometer of these errors gives; readings (N, 2) deg until 0.5 s later."""
    last = len(readings) - 1 - round(0.5 / period_s)
    variance = errors.noise_rad**2
    third = variance if axes == 3 else 0.0
    messages = (sample((k - last) * period_s, *xy, 0, variance, third) for k, xy in enumerate(readings))
    tilt = buffer_of(messages).average(T0, 0.5)
    errors.check_live(tilt)
    return tilt


def at_rest(rng, number, noise_deg):
    return np.array([3.1234, -11.7777]) + rng.normal(0, noise_deg, (number, 2))


@pytest.mark.parametrize(
    "kind", ["zeros", "from the start", "since a while", "one axis", "to a degree", "to 0.1 deg"]
)
def test_a_topic_whose_level_does_not_measure_gives_no_tilt(kind, rng):
    live = at_rest(rng, 300, 0.0035)
    lies = {
        "zeros": np.zeros((60, 2)),
        "from the start": np.full((60, 2), -4.51234),
        "since a while": np.concatenate([live[:200], np.tile(live[200], (100, 1))]),
        "one axis": np.stack([np.full(300, 3.1224), live[:, 1]], 1),
        "to a degree": np.round(live),
        "to 0.1 deg": np.round(live, 1),
    }
    with pytest.raises(TiltError, match="repeats the same value"):
        judged(lies[kind], LEVEL)
    if kind in ("zeros", "since a while", "one axis"):
        with pytest.raises(TiltError, match="repeats the same value"):
            judged(lies[kind], LEVEL, axes=2)


def test_a_mean_of_an_inclinometer_that_its_driver_repeats_is_believed():
    """A stuck one is flagged by the driver; of a rounded mean the rounding counts."""
    tilt = judged(np.full((60, 2), -4.51234), LEVEL, axes=2)
    assert tilt.step_rad == 0 and np.degrees(tilt.theta[:2]) == pytest.approx([-4.51234] * 2)
    assert np.degrees(judged(np.full((60, 2), [3.0, -12.0]), LEVEL, axes=2).step_rad) > 0.1


@pytest.mark.parametrize(
    ("errors", "step_deg", "noise_deg", "period_s"),
    [
        (LEVEL, 0.0005, 0.0035, 0.1),
        # a rover that is parked by night: nothing shakes its IMU but the IMU's own noise
        (BMI088, 0.00525, 0.043, 0.01),
        (BMI088, 0.0001, 0.0005, 0.01),
        (ADIS16209, 0.025, 0.02, 0.1),
    ],
)
def test_a_topic_of_a_level_at_rest_is_believed(errors, step_deg, noise_deg, period_s, rng):
    tilt = judged(np.round(at_rest(rng, 600, noise_deg) / step_deg) * step_deg, errors, period_s)
    assert tilt.step_rad == 0 and np.degrees(tilt.theta[:2]) == pytest.approx([3.1234, -11.7777], abs=0.03)


def test_a_topic_of_an_old_level_whose_coarse_steps_are_stated_costs_them(rng):
    old = InclinometerErrors(quantum_rad=math.radians(0.1))
    tilt = judged(np.round(at_rest(rng, 300, 0.0035), 1), old)
    assert np.degrees(old.undithered_rad(tilt)) == pytest.approx(0.1 / math.sqrt(12), rel=0.05)

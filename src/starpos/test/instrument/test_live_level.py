# SPDX-License-Identifier: Apache-2.0
"""Levels that do not measure (dead, frozen, rounded), and sound ones that look alike."""

import math

import numpy as np
import pytest

from starpos.errors import TiltError
from starpos.instrument import sensors
from starpos.instrument.inclinometer import InclinometerErrors
from starpos.instrument.tilt_log import TiltLog

SENSOR = InclinometerErrors()
ADIS16209 = sensors.find("adis16209")[1]
COARSE = InclinometerErrors(quantum_rad=np.radians(0.1))


def log(theta_x_deg, theta_y_deg, noise_rad=SENSOR.noise_rad):
    x, y = np.broadcast_arrays(theta_x_deg, theta_y_deg)
    return TiltLog.of(1000 + 0.1 * np.arange(len(x)), *np.radians([x, y]), np.full(len(x), 15.0), noise_rad)


def read(rng, step_deg=0.0, noise_deg=0.0035, number=60, theta_deg=(3.123, -11.777)):
    """Readings of an instrument at rest, rounded to a step."""
    theta = np.array(theta_deg)[:, None] + rng.normal(0, noise_deg, (2, number))
    return np.round(theta / step_deg) * step_deg if step_deg else theta


@pytest.mark.parametrize("value", [(0.0, 0.0), (-4.5, -4.5), (3.14159, -2.71828), (12.0, 3.0)])
def test_a_level_that_repeats_from_the_start_is_refused(value):
    tilt = log(np.full(30, value[0]), value[1]).average(1001.5, 1.0)
    with pytest.raises(TiltError, match="repeats the same value"):
        SENSOR.check_live(tilt)


def test_one_axis_that_repeats_is_refused(rng):
    x, _ = read(rng)
    with pytest.raises(TiltError, match="repeats the same value"):
        SENSOR.check_live(log(x, 1.25).average(1003.0, 1.0))


def test_a_few_live_readings_do_not_excuse_a_frozen_level(rng):
    x, y = read(rng, number=300)
    x[15:], y[15:] = x[15], y[15]
    with pytest.raises(TiltError, match="repeats the same value"):
        SENSOR.check_live(log(x, y).average(1020.0, 1.0))


def test_stated_steps_explain_readings_that_repeat(rng):
    tilt = log(*read(rng, 0.1)).average(1003.0, 1.0)
    COARSE.check_live(tilt)
    assert COARSE.coarser(tilt.step_rad) == ""
    assert COARSE.undithered_rad(tilt) == pytest.approx(np.radians(0.1) / math.sqrt(12), rel=0.05)
    tilt = log(*read(rng, 0.025), ADIS16209.noise_rad).average(1003.0, 1.0)
    ADIS16209.check_live(tilt)


@pytest.mark.parametrize("number", [1, 9])
def test_few_equal_readings_are_believed(number):
    SENSOR.check_live(
        log(np.full(number, 3.12345), -2.71828).average(1000 + 0.05 * (number - 1), 0.1 * number)
    )


@pytest.mark.parametrize("step_deg", [0.0, 1e-6, 1e-4, 0.001, 0.005])
def test_a_live_level_is_believed_as_before(rng, step_deg):
    tilt = log(*read(rng, step_deg)).average(1003.0, 1.0)
    SENSOR.check_live(tilt)
    assert tilt.step_rad == 0


def test_a_level_quieter_than_stated_is_believed(rng):
    tilt = log(*read(rng, 0.0005, 0.0002, 600)).average(1003.0, 1.0)
    SENSOR.check_live(tilt)
    assert tilt.step_rad == 0


@pytest.mark.parametrize("step_deg", [0.1, 0.5, 1.0])
def test_rounded_readings_of_several_poses_cost_their_rounding(rng, step_deg):
    poses = np.repeat(rng.uniform(-20, 20, (2, 8)), 20, axis=1)
    rounded = log(*np.round((poses + rng.normal(0, 0.0035, poses.shape)) / step_deg) * step_deg)
    tilt = rounded.average(1001.0, 1.0)
    SENSOR.check_live(tilt)
    assert np.degrees(tilt.step_rad) == pytest.approx(step_deg)
    assert SENSOR.undithered_rad(tilt) == pytest.approx(tilt.step_rad / math.sqrt(12), rel=0.05)
    assert f"steps of {step_deg:.2g} deg" in SENSOR.coarser(rounded.step_rad)


def test_the_steps_of_a_converter_cost_their_rounding(rng):
    """Steps that no decimal number has, between which a reading flips at times."""
    step_deg = 0.0417
    flips = rng.random((2, 60)) < 0.15
    tilt = log(*(np.array([[75], [-282]]) + flips) * step_deg).average(1003.0, 1.0)
    assert np.degrees(tilt.step_rad) == pytest.approx(step_deg)


def test_noise_larger_than_a_step_averages_as_before(rng):
    assert log(*read(rng, 0.1, 0.2), np.radians(0.2)).average(1003.0, 4.0).step_rad == 0
    assert log(*read(rng, 0.1, 0.06), np.radians(0.06)).average(1003.0, 4.0).step_rad == 0

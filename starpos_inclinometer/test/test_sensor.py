# SPDX-License-Identifier: Apache-2.0
"""Codes to angles by hand, and the flags."""

import math

import numpy as np
import pytest

from starpos_inclinometer import sensor
from starpos_inclinometer.protocol import Sample, Status
from starpos_inclinometer.sensor import Calibration, Sensor


def sample(x=0x800000, y=0x800000, temperature=175, status=0, **more):
    return Sample(0, 0, x, y, temperature, status, **more)


def test_codes_by_hand():
    """31 x 80 mV = 2.48 V of the sensor's output is half the range; 30 deg is 2 V, 2 / 2.48 of it."""
    c = Calibration()
    assert c.volts(0x800000) == 2.5
    assert c.volts(0) == pytest.approx(0.02, abs=1e-12)
    assert c.code(4.5) == 0x800000 + round(2.0 / 2.48 * 2**23)
    reading = Sensor().measure(sample(x=c.code(4.5) - 1, y=c.code(2.5 - 4 * math.sin(math.radians(5)))))
    assert math.degrees(reading.x) == pytest.approx(30.0, abs=2e-5)
    assert math.degrees(reading.y) == pytest.approx(-5.0, abs=1e-5)
    assert reading.flags == 0


def test_offset_sensitivity_divider_and_reference_of_each_axis():
    c = Calibration((2.4, 2.6), (3.9, 4.1), 40.0, 5.2)
    reading = Sensor(c).measure(sample(c.code(2.4 + 3.9 * 0.1), c.code(2.6 - 4.1 * 0.2)))
    assert math.sin(reading.x) == pytest.approx(0.1, abs=1e-6)
    assert math.sin(reading.y) == pytest.approx(-0.2, abs=1e-6)


def test_temperature_of_the_data_sheet():
    assert sensor.temperature_c(197) == 0.0
    assert sensor.temperature_c(170) == pytest.approx(24.93, abs=0.01)
    assert [sensor.temperature_c(sensor.temperature_counts(t)) for t in (-40, 20, 85)] == pytest.approx(
        [-40, 20, 85], abs=0.47
    )
    assert math.isnan(Sensor().measure(sample(status=Status.NO_TEMPERATURE)).temperature_c)


def test_variance_is_noise_and_quantisation():
    quiet = Sensor(Calibration(noise_rad=0.0)).measure(sample())
    step = 31 * 0.08 / 2**23 / 4.0
    assert quiet.variance_x == pytest.approx(step**2 / 12)
    assert Sensor().measure(sample()).variance_y == pytest.approx(math.radians(0.0035) ** 2, rel=1e-4)


@pytest.mark.parametrize(
    ("what", "flags"),
    [
        (sample(), 0),
        (sample(x=Calibration().code(2.5 + 4 * math.sin(math.radians(30.01)))), sensor.OUT_OF_RANGE),
        (sample(y=0), sensor.OUT_OF_RANGE | sensor.SATURATED),
        (sample(y=0xFFFFFF), sensor.OUT_OF_RANGE | sensor.SATURATED),
        (sample(lost=3), sensor.GAP),
        (sample(restarted=True), sensor.GAP),
        (sample(resumed=True), sensor.GAP),
        (sample(status=Status.ADC_TIMEOUT), sensor.STUCK),
        (sample(status=Status.NO_REFERENCE), sensor.STUCK),
        (sample(status=Status.OVERRUN | 0xC0), 0),
    ],
)
def test_flags(what, flags):
    reading = Sensor().measure(what)
    assert reading.flags == flags
    assert np.isfinite([reading.x, reading.y, reading.variance_x, reading.variance_y]).all()


def test_angles_stay_finite_where_there_is_none():
    reading = Sensor(Calibration(sensitivity_volts_per_g=(1.0, 1.0))).measure(sample(x=0, y=0xFFFFFF))
    assert (reading.x, reading.y) == pytest.approx((-math.pi / 2, math.pi / 2))
    assert reading.flags & sensor.OUT_OF_RANGE


def test_a_code_that_repeats_is_stuck_until_it_moves():
    s = Sensor()
    flags = [s.measure(sample(x=0x800000 + i, y=0x812345)).flags for i in range(sensor.STUCK_SAMPLES + 1)]
    assert flags == [0] * (sensor.STUCK_SAMPLES - 1) + [sensor.STUCK] * 2
    assert s.measure(sample(y=0x812346)).flags == 0

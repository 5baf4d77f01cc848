# SPDX-License-Identifier: Apache-2.0
"""Codes to angles by hand, and the flags."""

import math

import numpy as np
import pytest

from starpos.messages.tilt import GAP, OUT_OF_RANGE, SATURATED, STUCK
from starpos.parameters.table import defaults_of
from starpos_inclinometer.sources import tilts
from starpos_inclinometer.sources.mcu_protocol import Sample, SampleStatus
from starpos_inclinometer.sources.tilts import SQUARE_AXES, Sca100t
from starpos_testing.emulator import code_of, temperature_counts

DEFAULTS = defaults_of("inclinometer")


def calibration(**changes):
    """Parameters of the node; in the names of the changed ones __ stands for a dot."""
    return DEFAULTS | {name.replace("__", "."): value for name, value in changes.items()}


def sensor(values=DEFAULTS, **settings):
    made = Sca100t(values)
    for name, value in settings.items():
        setattr(made, name, value)
    return made


def measure(sample, *calibration, **settings):
    return sensor(*calibration, **settings).measure(sample, 0.0)


def sample(x=0x800000, y=0x800000, temperature=175, status=0, **more):
    return Sample(sequence=0, milliseconds=0, x=x, y=y, temperature=temperature, status=status, **more)


def test_codes_by_hand():
    """31 x 80 mV = 2.48 V of the sensor's output is half the range; 30 deg is 2 V, 2 / 2.48 of it."""
    c = sensor()
    assert c.volts(0x800000) == 2.5
    assert c.volts(0) == pytest.approx(0.02, abs=1e-12)
    assert code_of(4.5) == 0x800000 + round(2.0 / 2.48 * 2**23)
    reading = measure(sample(x=code_of(4.5) - 1, y=code_of(2.5 - 4 * math.sin(math.radians(5)))))
    assert math.degrees(reading.x) == pytest.approx(30.0, abs=2e-5)
    assert math.degrees(reading.y) == pytest.approx(-5.0, abs=1e-5)
    assert reading.flags == 0


def test_offset_sensitivity_divider_and_reference_of_each_axis():
    c = calibration(offset_volts=[2.4, 2.6], sensitivity=[3.9, 4.1], divider=40.0, reference_volts=5.2)
    reading = measure(sample(*(code_of(v, 40.0, 5.2) for v in (2.4 + 3.9 * 0.1, 2.6 - 4.1 * 0.2))), c)
    assert math.sin(reading.x) == pytest.approx(0.1, abs=1e-6)
    assert math.sin(reading.y) == pytest.approx(-0.2, abs=1e-6)


def test_temperature_of_the_data_sheet():
    counts = {197: 0.0, 170: 24.93} | {temperature_counts(t): t for t in (-40, 20, 85)}
    got = [measure(sample(temperature=n)).temperature_c for n in counts]
    assert got == pytest.approx(list(counts.values()), abs=0.47)
    assert math.isnan(measure(sample(status=SampleStatus.NO_TEMPERATURE)).temperature_c)


def test_until_the_noise_is_known_it_is_the_stated_one_and_the_quantisation():
    stated, step = math.radians(0.0035), 31 * 0.08 / 2**23 / 4.0
    variance = stated**2 + step**2 / 12
    assert measure(sample()).covariance == pytest.approx((variance, 0, 0, variance), rel=1e-9)


def test_the_noise_parameter_is_a_floor_that_the_samples_may_rise_above():
    rng = np.random.default_rng(1)
    for floor, noise, expected in ((0.004, 0.001, 0.004), (0.001, 0.004, 0.004)):
        s = sensor(noise_floor_rad=math.radians(floor))
        for k in range(300):
            volts = 2.5 + 4 * np.radians(noise) * rng.standard_normal(2)
            last = s.measure(sample(*map(code_of, volts)), 0.1 * k)
        sigma = np.degrees(np.sqrt([last.covariance[0], last.covariance[3]]))
        assert sigma == pytest.approx([expected] * 2, rel=0.2)


def turned(gx, gy, c, at=20.0, cross_axis=SQUARE_AXES):
    """The codes of what an instrument with the calibration's own errors feels."""
    g = np.linalg.solve(np.array(cross_axis).reshape(2, 2), [gx, gy])
    pairs = (sensor(c).offset_and_sensitivity(axis, at) for axis in range(2))
    return [
        code_of(offset + sensitivity * share) for (offset, sensitivity), share in zip(pairs, g, strict=True)
    ]


def test_cross_axis_matrix_and_its_covariance():
    c, matrix = DEFAULTS, (0.99, 0.05, -0.03, 1.01)
    gx, gy = math.sin(math.radians(12)), math.sin(math.radians(-20))
    reading = measure(sample(*turned(gx, gy, c, cross_axis=matrix)), cross_axis=matrix)
    assert np.degrees([reading.x, reading.y]) == pytest.approx([12, -20], abs=1e-5)
    # by differences: one code more on each axis
    x, y = turned(gx, gy, c, cross_axis=matrix)
    jump = 100_000
    slopes = []
    for k in range(2):
        moved = measure(sample(x + jump * (k == 0), y + jump * (k == 1)), cross_axis=matrix)
        slopes.append([(moved.x - reading.x), (moved.y - reading.y)])
    raw = np.linalg.solve(np.array(matrix).reshape(2, 2), [gx, gy])
    sigma_code = math.radians(0.0035) * np.sqrt(1 - raw**2) / (sensor(c).volts_per_code / 4.0)
    jacobian = np.array(slopes).T / jump * sigma_code
    expected = jacobian @ jacobian.T
    assert np.array(reading.covariance).reshape(2, 2) == pytest.approx(expected, rel=0.01)
    assert abs(expected[0, 1]) > 0.01 * expected[0, 0]


WARM = calibration(
    temperature__reference=25.0,
    temperature__offset_x=[5e-4, -2e-6, 1e-8],
    temperature__offset_y=[-3e-4, 1e-6, 0.0],
    temperature__sensitivity_x=[1e-4, 1e-6, 0.0],
    temperature__sensitivity_y=[-2e-4, 0.0, 1e-8],
)


@pytest.mark.parametrize("celsius", [-30.0, 25.0, 70.0])
def test_temperature_polynomials(celsius):
    t = celsius - 25.0
    volts = (
        2.5 + 5e-4 * t - 2e-6 * t**2 + 1e-8 * t**3 + 4.0 * (1 + 1e-4 * t + 1e-6 * t**2) * 0.1,
        2.5 - 3e-4 * t + 1e-6 * t**2 + 4.0 * (1 - 2e-4 * t + 1e-8 * t**3) * -0.2,
    )
    counts = temperature_counts(celsius)
    s = sensor(WARM)
    reading = s.measure(sample(*map(code_of, volts), temperature=counts), 0.0)
    # one count is 0.92 deg C, of which the offset of x makes 0.007 deg
    error = np.abs(np.sin([reading.x, reading.y]) - [0.1, -0.2])
    assert error.max() < 0.46 * 8e-4 / 4
    sigma = math.sqrt(reading.covariance[0] - math.radians(0.0035) ** 2)
    assert 0.5 * 0.92 * 5e-4 / 4 / math.sqrt(12) < sigma < 2.5 * 0.92 * 5e-4 / 4 / math.sqrt(12)


def test_one_count_of_temperature_comes_slowly_and_a_missing_one_changes_nothing_but_the_error():
    s = sensor(WARM)
    x, y = turned(0.1, -0.2, WARM)
    first = s.measure(sample(x, y, temperature=175), 0.0)
    stepped = s.measure(sample(x, y, temperature=174), 0.1)
    whole = 0.92 * 5e-4 / 4
    assert abs(stepped.x - first.x) < 0.01 * whole
    missing = s.measure(sample(x, y, status=SampleStatus.NO_TEMPERATURE, temperature=0), 0.2)
    assert math.isnan(missing.temperature_c) and missing.x == stepped.x
    for k in range(1, 61):
        later = s.measure(sample(x, y, status=SampleStatus.NO_TEMPERATURE, temperature=0), 10.0 * k)
    assert later.x == stepped.x
    assert math.sqrt(later.covariance[0]) > 20 * whole / 0.92 / 2
    back = s.measure(sample(x, y, temperature=174), 601.0)
    assert back.covariance[0] < later.covariance[0] / 100


def offset_x(linear, square):
    return calibration(temperature__offset_x=[linear, square, 0.0])


def test_a_polynomial_far_outside_of_its_range_does_not_turn_an_axis_round():
    c = calibration(
        temperature__sensitivity_x=[-0.01, 0.0, 0.0], temperature__sensitivity_y=[-0.01, -1e-4, 0.0]
    )
    counts = temperature_counts(125.0)
    reading = measure(sample(x=0x880000, y=0x780000, temperature=counts), c)
    assert reading.x > 0 > reading.y and np.isfinite(reading.covariance).all()


@pytest.mark.parametrize(
    "odd", [{"lost": 1}, {"status": SampleStatus.NO_ANSWER}, {"x": 0}, {"x": code_of(4.9)}]
)
def test_what_is_flagged_tells_no_noise(odd):
    s = sensor()
    for k in range(100):
        s.measure(sample(**({"x": 0x800000 + 37 * k % 101, "y": 0x800000 + k} | odd)), 0.1 * k)
    assert s.noise.sigma is None


def test_a_temperature_never_known_widens_the_error_by_all_it_may_be():
    """The compensation may be as large on both sides of the reference."""
    x_alone = (
        (WARM, 0.020),
        (offset_x(0.0, 1e-5), 0.016),
        (offset_x(5e-4, 1e-5), 0.036),
        (offset_x(-5e-4, 1e-5), 0.036),
    )
    for c, volts in x_alone:
        reading = measure(sample(status=SampleStatus.NO_TEMPERATURE), c)
        assert math.sqrt(reading.covariance[0]) > 0.8 * volts / 4
        assert measure(sample(temperature=170), c).covariance[0] < reading.covariance[0] / 100
    assert measure(sample(status=SampleStatus.NO_TEMPERATURE)).covariance == measure(sample()).covariance


@pytest.mark.parametrize(
    ("what", "flags"),
    [
        (sample(), 0),
        (sample(x=code_of(2.5 + 4 * math.sin(math.radians(30.01)))), OUT_OF_RANGE),
        (sample(y=0), OUT_OF_RANGE | SATURATED),
        (sample(y=0xFFFFFF), OUT_OF_RANGE | SATURATED),
        (sample(lost=3), GAP),
        (sample(broken=True), GAP),
        (sample(status=SampleStatus.NO_ANSWER), STUCK),
        (sample(status=SampleStatus.MEANINGLESS), STUCK),
        (sample(status=SampleStatus.OVERRUN), 0),
        (sample(status=SampleStatus.SELF_TEST), STUCK),
        (sample(status=SampleStatus.UPSIDE_DOWN), OUT_OF_RANGE),
    ],
)
def test_flags(what, flags):
    reading = measure(what)
    assert reading.flags == flags
    assert np.isfinite([reading.x, reading.y, *reading.covariance]).all()


def test_angles_stay_finite_where_there_is_none():
    reading = measure(sample(x=0, y=0xFFFFFF), calibration(sensitivity=[1.0, 1.0]))
    assert (reading.x, reading.y) == pytest.approx((-math.pi / 2, math.pi / 2))
    assert reading.flags & OUT_OF_RANGE


def test_a_code_that_repeats_is_stuck_until_it_moves():
    s = sensor()
    flags = [
        s.measure(sample(x=0x800000 + i, y=0x812345), 0.1 * i).flags
        for i in range(tilts.SCA100T_STUCK_SAMPLES + 1)
    ]
    assert flags == [0] * (tilts.SCA100T_STUCK_SAMPLES - 1) + [STUCK] * 2
    assert s.measure(sample(y=0x812346), 9.0).flags == 0


def test_both_codes_repeating_are_stuck_sooner():
    s = sensor()
    assert [s.measure(sample(), 0.1 * i).flags for i in range(4)] == [0, 0, STUCK, STUCK]

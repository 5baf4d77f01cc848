# SPDX-License-Identifier: Apache-2.0
"""Sensors that Linux's own drivers read: their channels, and everything such a folder may hold or lose."""

import math
import shutil
import time

import numpy as np
import pytest
from iio_tree import adxl355, plug, scl3300

from starpos.messages.tilt import GAP, OUT_OF_RANGE, STUCK, TIME_UNKNOWN
from starpos.parameters.table import defaults_of
from starpos_inclinometer.clock import HostClock, Moment
from starpos_inclinometer.sources.iio import IioSource
from starpos_inclinometer.sources.iio_device import DeviceError, find, set_sampling_frequency
from starpos_inclinometer.sources.source import Arrival, Phase, Surroundings
from starpos_testing.patience import WAIT_S

DEFAULTS = defaults_of("inclinometer")


def source_of(values):
    return IioSource(Surroundings(None, HostClock(), lambda: None), values)


def arrivals(device, raws, period_s=0.01, dated=True):
    for k, raw in enumerate(raws):
        moment = Moment(100 + k * period_s, round(1.7e18 + k * period_s * 1e9))
        yield Arrival(tuple(raw), moment, device, dated)


def test_an_scl3300_is_read_by_its_angles_with_its_presets_noise_and_temperature(tmp_path):
    scl3300(tmp_path)
    device = find(tmp_path, "")
    assert (device.model, device.kind, len(device.channels)) == ("scl3300", "incli", 3)
    tilts = source_of(DEFAULTS)
    (arrival,) = arrivals(device, [device.read_raw()])
    reading = tilts.read(arrival)
    assert np.degrees([reading.x, reading.y, reading.z]) == pytest.approx([3.0, -1.5, 86.6], abs=0.003)
    # the sheet's -273 + TEMP / 18.9
    assert reading.temperature_c == pytest.approx(20.12, abs=0.01)
    # 0.001 deg/sqrt(Hz) in 40 Hz
    assert np.degrees(math.sqrt(reading.covariance[0])) == pytest.approx(0.0081, abs=3e-4)
    assert reading.flags == 0 and reading.stamp_ns == 1_700_000_000_000_000_000


def test_offset_scale_and_range_are_the_channels_own(tmp_path):
    plug(
        tmp_path,
        name="ADIS16209",
        in_incli_x_raw=99,
        in_incli_x_offset=1,
        in_incli_y_raw=-1400,
        in_incli_scale=0.025,
        in_incli_offset=0,
    )
    device = find(tmp_path, "adis16209")
    (arrival,) = arrivals(device, [device.read_raw()])
    reading = source_of(DEFAULTS).read(arrival)
    assert np.degrees([reading.x, reading.y]) == pytest.approx([2.5, -35.0])
    # its sheet's figures hold to 30 deg
    assert reading.flags == OUT_OF_RANGE and math.isnan(reading.z) and math.isnan(reading.temperature_c)


@pytest.mark.parametrize("shared", ["scale", "in_scale", "in_incli_scale"])
def test_a_scale_that_all_channels_share_is_the_channels(tmp_path, shared):
    plug(tmp_path, name="some", in_incli_x_raw=100, in_incli_y_raw=-200, **{shared: 0.01})
    device = find(tmp_path, "")
    assert np.allclose(np.degrees(device.angles(device.read_raw())), [1.0, -2.0])


def test_accelerations_are_averaged_and_g_is_not_taken_for_metres(tmp_path):
    adxl355(tmp_path)
    plug(tmp_path, 1, name="sca3300", in_accel_scale=0.00037, **{f"in_accel_{a}_raw": 1 for a in "xyz"})
    rng = np.random.default_rng(1)
    up = np.array([math.sin(math.radians(-3)), math.sin(math.radians(6)), 0])
    up[2] = math.sqrt(1 - up @ up)
    for name, one_g, noise in (("adxl355", 256417, 1e-4), ("sca3300", 2703, 4e-4)):
        device, tilts = find(tmp_path, name), source_of(DEFAULTS)
        raw = rng.normal(up * one_g, one_g * noise, (60, 3)).round()
        temperature = [[1885.0]] * 60 if device.temperature else [[]] * 60
        raw = [(*r, *t) for r, t in zip(raw, temperature, strict=True)]
        got = [r for a in arrivals(device, raw) if (r := tilts.read(a))]
        assert len(got) == 1 and not tilts.forces.unrest
        assert np.degrees([got[0].x, got[0].y]) == pytest.approx([-3, 6], abs=0.02)
        sigma = math.sqrt(noise**2 / 50 + 1 / one_g**2 / 12)
        assert math.sqrt(got[0].covariance[0]) == pytest.approx(sigma, rel=0.3)
    assert find(tmp_path, "adxl355").temperature_c((0, 0, 0, 1885.0)) == pytest.approx(25.0, abs=0.1)


def test_a_driving_accelerometer_gives_no_tilt(tmp_path):
    adxl355(tmp_path)
    device, tilts = find(tmp_path, ""), source_of(DEFAULTS)
    raw = [(30_000 * k, 0, 256417, 1885) for k in range(20)] * 3
    assert [r for a in arrivals(device, raw) if (r := tilts.read(a))] == []
    assert "m/s2" in tilts.forces.unrest


def test_equal_readings_are_a_stuck_device_and_another_device_is_a_gap(tmp_path):
    scl3300(tmp_path)
    device, tilts = find(tmp_path, ""), source_of(DEFAULTS | {"iio.stuck_samples": 5})
    flags = [tilts.read(a).flags for a in arrivals(device, [device.read_raw()] * 6)]
    assert flags == [0] * 4 + [STUCK] * 2
    again = find(tmp_path, "")
    (arrival,) = arrivals(again, [(550, -273, 15760, 5540)], dated=False)
    assert tilts.read(arrival).flags == GAP | TIME_UNKNOWN


@pytest.mark.parametrize(
    ("make", "wanted", "said"),
    [
        (lambda root: None, "", "no inclinometer or accelerometer"),
        (scl3300, "adxl355", "iio:device0 (scl3300)"),
        (lambda root: (scl3300(root), scl3300(root, 1)), "scl3300", "set `iio.device` to one's number"),
        (lambda root: plug(root, name="adc", in_voltage0_raw=1), "adc", "no inclinations of x and y"),
        (
            lambda root: plug(root, name="adis16209", in_incli_x_raw=1, in_incli_y_raw=1),
            "adis16209",
            "with a scale",
        ),
    ],
)
def test_what_cannot_be_read_is_refused_in_a_sentence(tmp_path, make, wanted, said):
    make(tmp_path)
    with pytest.raises(DeviceError) as refused:
        find(tmp_path, wanted)
    assert said in str(refused.value) and "\n" not in str(refused.value)


@pytest.mark.parametrize("wanted", ["1", "iio:device1", "SCL3300"])
def test_a_device_is_found_by_name_and_number(tmp_path, wanted):
    adxl355(tmp_path)
    scl3300(tmp_path, 1)
    assert find(tmp_path, wanted).model == "scl3300"


def test_the_sampling_frequency_is_set_or_its_choices_are_told(tmp_path):
    device = find(tmp_path, adxl355(tmp_path).name)
    assert set_sampling_frequency(device, 125).sampling_hz == 125
    assert (device.folder / "sampling_frequency").read_text() == "125\n"
    (device.folder / "sampling_frequency").unlink()
    with pytest.raises(DeviceError, match="has no sampling frequency"):
        set_sampling_frequency(device, 125)


@pytest.mark.parametrize("second", ["scl3300", "adis16209", "adxl355"])
def test_another_device_has_its_own_noise(tmp_path, second):
    """The first is ten times as noisy as any sheet says, and is replaced, as a number's owner is after a reboot."""
    rng = np.random.default_rng(2)
    scl3300(tmp_path)
    values = DEFAULTS | {"iio.device": ""}
    first, tilts = find(tmp_path, "scl3300"), source_of(values)
    for a in arrivals(first, [(*rng.normal(0, 15, 3).round(), 5540.0) for _ in range(300)], 0.02):
        tilts.read(a)
    assert np.degrees(tilts.angles.noise.sigma[0]) > 0.05
    if second == "adis16209":
        shape = {"in_incli_scale": 0.025, "in_incli_x_raw": 0, "in_incli_y_raw": 0}
        plug(tmp_path, 1, name=second, **shape)
    elif second == "scl3300":
        scl3300(tmp_path, 1)
    else:
        adxl355(tmp_path, 1)
    device = find(tmp_path, "1")
    raw = [device.read_raw()] * 60
    got = [r for a in arrivals(device, raw, 0.01) if (r := tilts.read(a))]
    assert got[0].flags & GAP
    fresh = source_of(values)
    alone = [r for a in arrivals(device, raw, 0.01) if (r := fresh.read(a))]
    assert got[0].covariance == pytest.approx(alone[0].covariance)


def test_a_device_that_goes_and_comes_back_is_read_again(tmp_path):
    """Comes back under another number, as the kernel may give it; a half-written value is dropped."""
    scl3300(tmp_path)
    values = DEFAULTS | {"iio.root": str(tmp_path), "iio.device": "scl3300", "rate": 50}
    link = IioSource(Surroundings(None, HostClock(), lambda: None), values)
    end_s = time.monotonic() + WAIT_S

    def wait(condition):
        while not condition():
            assert time.monotonic() < end_s, link.health()
            link.arrivals()

    link.start()
    try:
        wait(lambda: link.health().phase is Phase.RECEIVING)
        (tmp_path / "iio:device0/in_incli_x_raw").write_text("")
        wait(lambda: link.health().phase is Phase.GARBLED)
        (tmp_path / "iio:device0/in_incli_x_raw").write_text("546\n")
        wait(lambda: link.health().phase is Phase.RECEIVING)
        shutil.rmtree(tmp_path / "iio:device0")
        wait(lambda: link.health().phase is Phase.ABSENT)
        scl3300(tmp_path, 3)
        wait(lambda: link.health().phase is Phase.RECEIVING and "iio:device3" in link.health().sentence)
        assert link.health().values["openings"] == 2 and link.health().counts.malformed > 0
    finally:
        link.stop()

# SPDX-License-Identifier: Apache-2.0
"""Sensors that Linux's own drivers read: their channels and buffers, and everything such a folder may hold or lose."""

import math
import os
import shutil
import time

import numpy as np
import pytest
from iio_tree import adxl355, node, plug, scan, scl3300

from starpos.messages.tilt import GAP, OUT_OF_RANGE, STUCK, TIME_UNKNOWN
from starpos.parameters.table import defaults_of
from starpos_inclinometer.clock import HostClock, Moment
from starpos_inclinometer.sources.iio import IioLink, IioSource
from starpos_inclinometer.sources.iio_device import (
    Buffer,
    DeviceError,
    ScanLayout,
    find,
    set_sampling_frequency,
)
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


@pytest.mark.parametrize(
    ("text", "data", "number"),
    [
        ("le:s12/16>>4", b"\xf0\xff", -1),
        ("be:u16/16>>0", b"\x80\x00", 32768),
        ("be:s20/32>>12", b"\x80\x00\x00\x00", -(1 << 19)),
        ("le:s64/64>>0", b"\x01" + b"\0" * 7, 1),
        ("le:s16/16", b"\xfe\xff", -2),
    ],
)
def test_elements_of_a_scan(text, data, number):
    assert ScanLayout({"in": text}).numbers(data)["in"].tolist() == [number]


def test_the_layout_is_the_one_of_the_kernels_document():
    """Four channels of 16, 32, 32 and 64 bits begin at 0, 4, 8 and 16; the first and last alone at 0 and 8."""
    kinds = ["be:u16/16>>0", "be:u32/32>>0", "be:u32/32>>0", "be:u64/64>>0"]
    types = {str(i): kind for i, kind in enumerate(kinds)}
    scan = b"".join([b"\0\1\xff\xff", b"\0\0\0\2", b"\0\0\0\3", b"\xff" * 4, b"\0" * 7 + b"\4"])
    whole, two = ScanLayout(types), ScanLayout({name: types[name] for name in "03"})
    assert (whole.dtype.itemsize, two.dtype.itemsize) == (24, 16)
    assert [v.tolist() for v in whole.numbers(2 * scan).values()] == [[1, 1], [2, 2], [3, 3], [4, 4]]
    assert [v.tolist() for v in two.numbers(scan[:4] + b"\xff" * 4 + scan[16:]).values()] == [[1], [4]]
    with pytest.raises(DeviceError, match="a format that is not known"):
        ScanLayout({"in": "le:f32/32X2>>0"})


def test_buffered_scans_have_the_kernels_stamps_and_the_device_is_set_up_for_them(tmp_path):
    folder, nodes = adxl355(tmp_path), tmp_path / "dev"
    nodes.mkdir()
    writer = node(nodes)
    buffer = Buffer(find(tmp_path, ""), "adxl355-dev0", nodes)
    assert (folder / "trigger/current_trigger").read_text() == "adxl355-dev0\n"
    assert (folder / "current_timestamp_clock").read_text() == "monotonic\n"
    assert (folder / "buffer/enable").read_text() == "1\n"
    enabled = {p.name for p in (folder / "scan_elements").glob("*_en") if p.read_text() == "1"}
    assert enabled == {f"in_{n}_en" for n in ("accel_x", "accel_y", "accel_z", "temp", "timestamp")}
    data = scan(-13421, 26828, 254288, 1885, 5_000_000_123) + scan(1, -1, 0, 1886, 5_008_000_123)
    # the second comes in two pieces
    os.write(writer, data[:30])
    assert buffer.read(1.0) == [((-13421, 26828, 254288, 1885), 5.000000123)]
    os.write(writer, data[30:])
    assert [raw for raw, _ in buffer.read(1.0)] == [(1, -1, 0, 1886)]
    assert buffer.read(0.0) == []
    os.close(writer)
    with pytest.raises(OSError, match="sends no more"):
        buffer.read(1.0)
    buffer.close()
    assert (folder / "buffer/enable").read_text() == "0\n"


def test_a_buffer_that_is_not_there_is_a_sentence(tmp_path):
    scl3300(tmp_path)
    with pytest.raises(DeviceError, match=r"has no buffer: unset `iio\.trigger`"):
        Buffer(find(tmp_path, ""), "any", tmp_path)
    adxl355(tmp_path, 1)
    with pytest.raises(DeviceError, match=r"check `iio\.trigger`"):
        Buffer(find(tmp_path, "adxl355"), "any", tmp_path / "nowhere")


@pytest.mark.parametrize("missing", ["dev/iio:device0", "iio:device0/scan_elements/in_temp_type"])
def test_a_buffer_that_cannot_be_opened_is_off_again(tmp_path, missing):
    """While the kernel fills it no program can read the device, and polling it would fail too."""
    folder, nodes = adxl355(tmp_path), tmp_path / "dev"
    nodes.mkdir()
    writer = node(nodes)
    (tmp_path / missing).unlink()
    (folder / "buffer/enable").write_text("1\n")
    with pytest.raises(DeviceError, match=r"check `iio\.trigger`"):
        Buffer(find(tmp_path, ""), "adxl355-dev0", nodes)
    assert (folder / "buffer/enable").read_text() == "0\n"
    os.close(writer)


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
    link = IioLink(Surroundings(None, HostClock(), lambda: None), values)
    end_s = time.monotonic() + WAIT_S

    def wait(condition):
        while not condition():
            assert time.monotonic() < end_s, link.health()
            link.fetch()

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

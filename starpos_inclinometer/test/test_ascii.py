# SPDX-License-Identifier: Apache-2.0
"""Lines of digital tiltmeters: what a pattern makes of them, what a port brings, and what is refused."""

import math
import os
import random
import threading
import time
import tty

import numpy as np
import pytest

from starpos.messages.tilt import GAP, OUT_OF_RANGE, STUCK, TIME_UNKNOWN
from starpos.parameters.table import defaults_of
from starpos_inclinometer.clock import HostClock, Moment
from starpos_inclinometer.sources.ascii_line import MAX_LINE, UNITS, AsciiSource, LineDecoder, TextLines
from starpos_inclinometer.sources.registry import SOURCES
from starpos_inclinometer.sources.source import Phase, Surroundings
from starpos_testing.emulator import Pty
from starpos_testing.patience import WAIT_S

NUMBER = r"[-+]?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?"
PLAIN = rf"(?P<x>{NUMBER}),(?P<y>{NUMBER})"
FULL = rf"\$TILT,(?P<sequence>\d+),(?P<milliseconds>\d+),{PLAIN},(?P<temperature>{NUMBER}|)"


def values(**changed):
    return defaults_of("inclinometer") | {"source": "ascii", "ascii.pattern": PLAIN} | changed


class Feeder:
    """A decoder whose lines come 0.1 s apart."""

    def __init__(self, pattern=PLAIN, **changed):
        given = {f"ascii.{name}": value for name, value in changed.items()}
        self.decoder = LineDecoder(values(**{"ascii.pattern": pattern} | given))
        self.now_s = 100.0

    def send(self, *texts):
        got = []
        for text in texts:
            self.now_s += 0.1
            data = text.encode("latin-1") + b"\r\n"
            got += [a.sample for a in self.decoder.decode(data, Moment(self.now_s, 0))]
        return got


@pytest.mark.parametrize(
    ("unit", "of_10_deg"),
    [
        ("deg", 10.0),
        ("arcmin", 600.0),
        ("arcsec", 36_000.0),
        ("rad", math.radians(10)),
        ("mrad", 1e3 * math.radians(10)),
        ("urad", 1e6 * math.radians(10)),
        ("g", math.sin(math.radians(10))),
        ("mg", 1e3 * math.sin(math.radians(10))),
        ("percent_g", 100 * math.sin(math.radians(10))),
    ],
)
def test_units(unit, of_10_deg):
    assert unit in UNITS
    line = f"{of_10_deg:.9f},{-of_10_deg:.9f}"
    got = Feeder(unit=unit).send(line, line)[-1]
    assert np.degrees([got.x, got.y]) == pytest.approx([10, -10], abs=1e-6)


def test_every_unit_there_is_is_tested():
    assert set(UNITS) == {m.args[1][k][0] for m in test_units.pytestmark for k in range(len(m.args[1]))}


def test_all_that_a_line_may_tell():
    first, second = Feeder(FULL).send("$TILT,7,1000,1.25,-2.5,21.5", "$TILT,8,1100,1.26,-2.5,")
    assert (first.sequence, first.milliseconds, first.temperature_c) == (7, 1000, 21.5)
    assert math.isnan(second.temperature_c) and second.lost == 0
    # The coarser of both.
    assert math.degrees(first.step) == pytest.approx(0.1)
    seconds = Feeder(rf"(?P<seconds>{NUMBER}) {PLAIN}").send("1700000000.25 1,2", "1700000000.35 1,2")
    assert [s.milliseconds for s in seconds] == [(1700000000_250 + k) & 0xFFFFFFFF for k in (0, 100)]


@pytest.mark.parametrize(
    ("line", "digit"), [("1.234,2.345", 1e-3), ("12,-3", 1.0), ("1.5e-2,2.5e-2", 1e-3), ("1.0,2.00", 0.1)]
)
def test_the_step_is_the_last_digits(line, digit):
    assert math.degrees(Feeder().send(line, line)[-1].step) == pytest.approx(digit)
    assert math.degrees(Feeder(resolution=0.25).send(line, line)[-1].step) == pytest.approx(0.25)


@pytest.mark.parametrize(
    "line",
    [
        "nan,1",
        "1,inf",
        "1e999,1",
        "x1,2",
        "1,2,3",
        "1;2",
        "400,1",
        "1,2 # x",
        "1_0,2",
        "١,٢",
        "1," + "0" * MAX_LINE,
    ],
)
def test_what_is_no_reading_gives_none(line):
    pattern = r"(?P<x>[^,]+),(?P<y>[^,]+)"
    feeder = Feeder(pattern if "#" not in line else PLAIN)
    feeder.send("1,2", "1,2")
    if line in ("1,2,3", "1;2", "1,2 # x"):
        assert feeder.send(line) == []
        return
    data = line.encode("utf-8").decode("latin-1")
    assert feeder.send(data, data) == []


THREE = rf"{PLAIN},(?P<z>{NUMBER})"


def test_a_third_axis_and_angles_that_are_counted_to_360_deg():
    got = Feeder(THREE).send(*["330,45.5,229.95"] * 2)[-1]
    assert np.degrees([got.x, got.y, got.z]) == pytest.approx([-30, 45.5, -49.95])
    assert math.degrees(got.step) == pytest.approx(1.0)
    # upside down, as the third axis shows
    over = Feeder(THREE).send(*["170,0,-80"] * 2)[-1]
    assert np.degrees([over.x, over.y, over.z]) == pytest.approx([10, 0, -80])
    two = Feeder().send(*["359.5,0.5"] * 2)[-1]
    assert np.degrees([two.x, two.y]) == pytest.approx([-0.5, 0.5]) and two.z is None
    sines = Feeder(THREE, unit="g").send(*["0.5,-0.5,-0.70710678"] * 2)[-1]
    assert np.degrees([sines.x, sines.y, sines.z]) == pytest.approx([30, -30, -45])


def test_numbers_lost_doubled_wrapped():
    send = Feeder(FULL).send
    got = send(*(f"$TILT,{k},{100 * k},1,2,20" for k in (5, 6, 6, 9, 10)))
    assert [(s.sequence, s.lost, s.broken) for s in got] == [
        (5, 0, False),
        (6, 0, False),
        (9, 2, False),
        (10, 0, False),
    ]
    got = send(*(f"$TILT,{k},{100 * k},1,2,20" for k in (0, 1)))
    assert [(s.sequence, s.broken) for s in got] == [(0, True), (1, False)]


def test_equal_lines_are_doubled_ones_only_where_they_are_numbered():
    feeder = Feeder()
    assert len(feeder.send(*["1.0,2.0"] * 10)) == 10 and feeder.decoder.counts.duplicates == 0
    numbered = Feeder(FULL)
    numbered.send("$TILT,1,100,1,2,", "$TILT,2,200,1,2,")
    assert numbered.send("$TILT,2,200,1,2,") == [] and numbered.decoder.counts.duplicates == 1


def test_a_wrong_digit_that_nothing_bears_out_is_dropped():
    feeder = Feeder()
    feeder.send("1.000,2.000", "1.001,2.000")
    assert feeder.send("7.001,2.000") == []
    assert len(feeder.send("1.000,2.001")) == 1
    assert feeder.decoder.counts.implausible == 1


def test_lines_of_any_end_in_any_pieces():
    stream = b"1,2\r\n3,4\n5,6\r7,8\r\n\r\n" + b"x" * 1000 + b"\n9,10\n"
    for size in (1, 3, 7, 100, 5000):
        lines = TextLines()
        got = [t for k in range(0, len(stream), size) for t in lines.split(stream[k : k + size])]
        assert got == ["1,2", "3,4", "5,6", "7,8", "9,10"]
        assert lines.counts.garbage_bytes == 1000 and len(lines._rest) <= MAX_LINE


def test_what_comes_first_on_a_new_connection_may_be_half_a_line():
    lines = TextLines()
    lines.split(b"1,23")
    lines.forget()
    assert lines.split(b"4,5\n6,7\n") == ["6,7"]


def test_a_million_bytes_of_anything_never_raise_and_are_never_believed():
    rng = random.Random(1)
    feeder = Feeder(FULL)
    alphabet = b"$TILT,0123456789.-+eE\r\n\x00\xff nai"
    for _ in range(250):
        noise = bytes(rng.choices(alphabet, k=2000)) + rng.randbytes(2000)
        assert feeder.decoder.decode(noise, Moment(0.0, 0)) == []
    lines = [f"$TILT,{k},{100 * k},1.25{k % 10},-2.50{k % 7},21.5\r\n".encode() for k in range(20_000)]
    said = {(k, 100 * k, f"1.25{k % 10}", f"-2.50{k % 7}") for k in range(20_000)}
    decoder, believed = Feeder(FULL).decoder, 0
    for k, line in enumerate(lines):
        # Something of the line is lost: the pattern knows where numbers begin, not where they end.
        if rng.random() < 0.1:
            cut = rng.randrange(1, len(line) - 3)
            line = line[:cut]
        for a in decoder.decode(line, Moment(0.1 * k, 0)):
            believed += 1
            s = a.sample
            x, y = (f"{math.degrees(v):.3f}" for v in (s.x, s.y))
            assert (s.sequence, s.milliseconds, x, y) in said
    assert believed > 15_000


@pytest.mark.parametrize(
    ("pattern", "words"),
    [
        ("(?P<x>[", "no regular expression"),
        (r"(?P<x>\d+)", "needs the named groups x and y"),
        (r"(?P<x>\d+),(?P<y>\d+),(?P<w>\d+)", "has a group w"),
        (r"(?P<x>.),(?P<y>.),(?P<seconds>.),(?P<milliseconds>.)", "keep one"),
        ("(" * 500, "no regular expression"),
    ],
)
def test_bad_patterns_are_refused_in_one_sentence(pattern, words):
    sentence = AsciiSource.refusal(values(**{"ascii.pattern": pattern}))
    assert words in sentence and "\n" not in sentence
    assert SOURCES["serial"].refusal(values(**{"ascii.pattern": pattern})) is None


def test_good_patterns_and_requests():
    assert AsciiSource.refusal(values(**{"ascii.pattern": FULL, "ascii.request": "?\r\n"})) is None
    assert AsciiSource.refusal(defaults_of("inclinometer") | {"source": "ascii"}) is None
    assert "ASCII" in AsciiSource.refusal(values(**{"ascii.request": "\xe9"}))


class Meter:
    """A tiltmeter on a port that says `line(k)` each period, or once for each request."""

    def __init__(self, path, line, request=b"", period_s=0.02):
        self.path = str(path)
        self.requests = 0
        self._port = Pty(self.path)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, args=(line, request, period_s))
        self._thread.start()

    def _run(self, line, request, period_s):
        k, heard = 0, b""
        while not self._stop.wait(period_s):
            heard += self._port.read()
            while request and request in heard:
                heard = heard.replace(request, b"", 1)
                self.requests += 1
                self._port.write(line(k))
                k += 1
            if not request:
                self._port.write(line(k))
                k += 1

    def close(self):
        self._stop.set()
        self._thread.join()
        self._port.close()


@pytest.fixture
def meter(tmp_path):
    meters = []

    def make(*arguments, **options):
        meters.append(Meter(tmp_path / "port", *arguments, **options))
        return meters[-1]

    yield make
    for meter in meters:
        meter.close()


def readings(path, enough, **parameters):
    """At least a number of readings of a source, and its health."""
    come = threading.Event()
    source = AsciiSource(Surroundings(None, HostClock(), come.set), values(port=path, **parameters))
    source.start()
    got = []
    try:
        while len(got) < enough:
            assert come.wait(WAIT_S), source.health()
            come.clear()
            got += source.fetch()
        return got, source.health()
    finally:
        source.stop()


def test_a_meter_that_talks(meter):
    rng = np.random.default_rng(1)
    noise = 0.002 * rng.standard_normal((3000, 2))
    path = meter(lambda k: b"%.4f,%.4f\r\n" % (3 + noise[k, 0], -11 + noise[k, 1])).path
    before = time.time()
    got, health = readings(path, 300, **{"ascii.period": 0.02})
    assert health.phase is Phase.RECEIVING and health.counts.malformed <= 1
    assert np.degrees([(r.x, r.y) for r in got]).mean(0) == pytest.approx([3, -11], abs=0.001)
    assert {r.flags & ~TIME_UNKNOWN for r in got} == {0}
    assert np.degrees(np.sqrt(got[-1].covariance[::3])) == pytest.approx([0.002] * 2, rel=0.4)
    assert np.diff([r.sequence for r in got]).tolist() == [1] * (len(got) - 1)
    stamps = np.array([r.stamp_ns for r in got]) * 1e-9
    assert (np.diff(stamps) >= 0).all() and before < stamps[0] and stamps[-1] < time.time()


def test_a_meter_that_is_asked(meter):
    device = meter(lambda k: b"1.00%d,2\n" % (k % 10), request=b"?\r\n", period_s=0.01)
    got, _ = readings(device.path, 10, **{"ascii.request": "?\r\n", "ascii.period": 0.05})
    assert 10 <= device.requests <= len(got) + 10


def test_a_device_clock_takes_the_jitter_out(meter):
    """Lines that are late by up to 15 ms; their clock says when they were taken."""
    rng = random.Random(1)
    begin = time.time()
    taken = []

    def line(k):
        taken.append(time.time())
        threading.Event().wait(rng.random() * 0.015)
        return b"$TILT,%d,%d,1.0,%.4f,20\r\n" % (k, 1000 * (taken[-1] - begin), k * 1e-4)

    got, health = readings(meter(line, period_s=0.01).path, 200, **{"ascii.pattern": FULL})
    assert health.counts.lost == 0 and abs(got[-1].temperature_c - 20) < 1e-9
    numbers = np.rint(np.degrees([r.y for r in got]) * 1e4).astype(int)
    late = (np.array([r.stamp_ns * 1e-9 for r in got]) - np.array(taken)[numbers])[50:]
    # The lines themselves scatter by 3.7 ms.
    assert np.median(np.abs(late - np.median(late))) < 0.002


def test_stuck_and_steep_and_reopened(meter):
    device = meter(lambda k: b"%d,2\n" % (45 if k > 60 else 1))
    some = {"ascii.stuck_samples": 20, "ascii.resolution": 0.01, "ascii.range": 30.0}
    got, _ = readings(device.path, 100, **some)
    # on a busy machine lines may come after a silence
    flags = [r.flags & ~TIME_UNKNOWN for r in got]
    assert flags[:19] == [0] * 19 and set(flags[19:50]) == {STUCK}
    assert flags[90] == STUCK | OUT_OF_RANGE
    assert not any(f & GAP for f in flags)
    never, _ = readings(device.path, 150, **{"ascii.stuck_samples": 0, "ascii.resolution": 0.01})
    assert not any(r.flags & STUCK for r in never)


def test_a_third_axis_is_published_and_no_lean_is_too_far(meter):
    device = meter(lambda k: b"45.%02d,-40.00,16.80\n" % (k % 7))
    got, _ = readings(device.path, 60, **{"ascii.pattern": THREE})
    assert not any(r.flags & ~TIME_UNKNOWN for r in got)
    assert np.degrees([(r.y, r.z) for r in got]) == pytest.approx(np.array([[-40, 16.8]] * len(got)))
    assert all(0 < r.z_variance < 1e-6 for r in got)


def test_a_third_axis_that_comes_and_goes_ends_nothing(meter):
    device = meter(lambda k: b"45.%02d,-40.00%s\n" % (k % 7, b"" if k % 50 > 40 else b",16.80"))
    got, _ = readings(device.path, 150, **{"ascii.pattern": rf"{PLAIN}(?:,(?P<z>{NUMBER}))?"})
    assert {math.isnan(r.z) for r in got} == {True, False}
    assert all(math.isnan(r.z) == math.isnan(r.z_variance) for r in got)


def test_upside_down_without_a_third_axis_is_out_of_range(meter):
    device = meter(lambda k: b"%d,2\n" % (170 + k % 3))
    got, _ = readings(device.path, 20)
    assert all(r.flags & OUT_OF_RANGE for r in got)
    assert all(math.isnan(r.z) and math.isnan(r.z_variance) for r in got)


def test_readings_that_all_stand_on_one_step_may_be_half_a_step_off(meter):
    device = meter(lambda k: b"1.00,2.00\n")
    got, _ = readings(device.path, 150, **{"ascii.stuck_samples": 0})
    sigma = np.degrees(np.sqrt([r.covariance[0] for r in (got[0], got[-1])]))
    assert sigma == pytest.approx([math.hypot(0.01, 0.01 / math.sqrt(12)), 0.01 / math.sqrt(12)], rel=1e-6)


def test_a_device_that_says_something_else(tmp_path):
    master, slave = os.openpty()
    tty.setraw(slave)
    come = threading.Event()
    source = AsciiSource(Surroundings(None, HostClock(), come.set), values(port=os.ttyname(slave)))
    source.start()
    try:
        end = time.monotonic() + WAIT_S
        while source.health().phase is not Phase.GARBLED:
            assert time.monotonic() < end, source.health()
            os.write(master, b"error 7\r\n")
            come.wait(0.1)
        assert "ascii.pattern" in source.health().sentence
    finally:
        source.stop()
        os.close(master)
        os.close(slave)

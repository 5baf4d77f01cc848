# SPDX-License-Identifier: Apache-2.0
"""What can go wrong between the sensor and the host, on the firmware in its emulated MCU: each with what came of it.

Every test records its `fault` and `result`, which the package's README has as a table.
"""

import math
import signal
import threading
import time
from itertools import dropwhile

import numpy as np
import pytest
from board import Board
from corrupted import RATE_HZ, as_sent, decode, flipped, forged, lines
from diagnostic_msgs.msg import DiagnosticArray
from wire import Wire

from starpos.messages.tilt import STUCK, TIME_UNKNOWN
from starpos.parameters.table import defaults_of
from starpos_inclinometer.clock import HostClock
from starpos_inclinometer.node import Reporter
from starpos_inclinometer.sources import mcu_protocol
from starpos_inclinometer.sources.mcu import McuDecoder, McuSource
from starpos_inclinometer.sources.source import Phase, Surroundings
from starpos_interfaces.msg import Tilt
from starpos_testing.emulator import Faults
from starpos_testing.nodes import Listener, Process, take_domain
from starpos_testing.patience import WAIT_S

TILT_DEG = (3.0, -11.0)
# Eight times the noise.
NEAR_DEG = 0.03


@pytest.fixture(scope="module", autouse=True)
def domain():
    take_domain()


@pytest.fixture
def board(built):
    board = Board(built, "--tilt", *map(str, TILT_DEG), speed=1)
    yield board
    assert board.close() == ""


@pytest.fixture
def wire(board, tmp_path):
    wire = Wire(board.path, tmp_path / "port")
    yield wire
    wire.cut()


@pytest.fixture
def tell(record_property):
    """Record what came of a fault."""

    def tell(fault, result):
        record_property("fault", fault)
        record_property("result", result)

    return tell


class Ears(Listener):
    """A listener with the tilts, and when each came."""

    def __init__(self):
        super().__init__()
        self.tilts, self.times, self.states_at = [], [], []
        self.node.create_subscription(Tilt, "tilt", self._tilt, 100)
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self._state, 10)

    def _tilt(self, message):
        self.tilts.append(message)
        self.times.append(time.monotonic())

    def _state(self, message):
        self.states_at.extend((time.monotonic(), s) for s in message.status if s.name == "inclinometer: Link")

    def told(self, since, level, text=""):
        """Seconds from `since` to the first report of that level and text."""

        def first():
            return next(
                (
                    t - since
                    for t, s in self.states_at
                    if t > since and s.level == bytes([level]) and text in s.message
                ),
                None,
            )

        self.wait(lambda: first() is not None)
        return first()

    def wrong(self):
        """Tilts that are not the board's and have no flag that says so."""
        bad = Tilt.STUCK | Tilt.SATURATED | Tilt.OUT_OF_RANGE
        return sum(
            not t.flags & bad
            and max(abs(math.degrees(v) - want) for v, want in zip((t.x, t.y), TILT_DEG, strict=True))
            > NEAR_DEG
            for t in self.tilts
        )


@pytest.fixture
def ears():
    ears = Ears()
    yield ears
    ears.close()


@pytest.fixture
def node():
    started = []

    def start(*parameters):
        started.append(Process("starpos_inclinometer.main", "inclinometer", parameters))
        return started[-1]

    yield start
    for process in started:
        process.kill()


def wrong(reader, wire):
    """Samples that were believed and never sent."""
    # what comes while this runs was sent before
    received, said = list(reader.samples), {as_sent(s) for s in wire.sent}
    return [a.sample for a in received if as_sent(a.sample) not in said]


def test_cable_pulled_and_put_back(wire, node, ears, tell):
    process = node(f"port:={wire.path}", "rate:=50")
    ears.wait(lambda: len(ears.tilts) >= 50)
    wire.cut()
    pulled = time.monotonic()
    told_s = ears.told(pulled, 2, "went away")
    ears.told(pulled, 2, "not there")
    n = len(ears.tilts)
    wire.join()
    back = time.monotonic()
    ears.wait(lambda: len(ears.tilts) >= n + 50)
    again_s = ears.times[n] - back
    assert ears.tilts[n].flags & Tilt.GAP and ears.wrong() == 0
    assert [b.sequence - a.sequence for a, b in zip(ears.tilts[n:], ears.tilts[n + 1 :], strict=False)] == [
        1
    ] * (len(ears.tilts) - n - 1)
    status, out = process.end(signal.SIGTERM)
    # a retry that logs each time would write dozens; a busy machine adds a line or two of its own
    assert status == 0 and "Traceback" not in out and len(out.splitlines()) <= 12
    tell(
        "cable pulled and put back",
        f"in diagnostics after {told_s:.1f} s; samples again {again_s:.1f} s after it was back; 0 wrong",
    )


def test_microcontroller_reset(board, wire, read, tell):
    reader = read(wire.path)
    reader.wait(lambda state, samples: len(samples) >= 50 and reader.identity)
    n = len(reader.samples)
    board.tell("hang")
    reader.wait(lambda state, samples: state.counts.restarts == 1)
    reader.wait(lambda state, samples: reader.identity.rate_hz == 50 and len(samples) >= n + 60)
    first = next(k for k, a in enumerate(reader.samples) if a.sample.broken)
    before, after = (reader.samples[k].moment.monotonic_s for k in (first - 1, first))
    sequence = [a.sample.sequence for a in reader.samples]
    assert sequence == sorted(set(sequence))
    assert [s for s in wrong(reader, wire) if not s.broken and s.sequence < sequence[first]] == []
    assert {(a.sample.x, a.sample.y) for a in reader.samples} <= {(s.x, s.y) for s in wire.sent}
    state = reader.link.health()
    assert (state.values["openings"], state.counts.implausible, state.counts.lost) == (1, 0, 0)
    tell(
        "MCU hangs, its watchdog resets it",
        f"samples again after {after - before:.1f} s, at the wanted rate, numbered on; 0 wrong",
    )


@pytest.mark.parametrize(
    ("fault", "faults", "counted"),
    [
        ("garbage between lines", Faults(garbage=0.5), "garbage_bytes"),
        ("truncated and doubled lines", Faults(truncate=0.2, double=0.3), "duplicates"),
        ("a line in ten lost", Faults(drop=0.1), "lost"),
    ],
)
def test_spoiled_lines(wire, read, tell, fault, faults, counted):
    reader = read(wire.path)
    reader.wait(lambda state, samples: len(samples) >= 20 and reader.identity)
    wire.faults, n = faults, len(reader.samples)
    state = reader.wait(lambda state, samples: len(samples) >= n + 200)
    assert wrong(reader, wire) == []
    assert getattr(state.counts, counted) > 10 and state.phase is Phase.RECEIVING
    sequence = [a.sample.sequence for a in reader.samples]
    assert sequence == sorted(set(sequence))
    got, sent = len(sequence), sequence[-1] - sequence[0] + 1
    assert got + state.counts.lost == sent
    tell(fault, f"{got} of {sent} samples, {state.counts.lost} counted as lost; 0 wrong")


def test_one_percent_flipped_bits(wire, read, tell):
    reader = read(wire.path)
    reader.wait(lambda state, samples: len(samples) >= 20 and reader.identity)
    wire.faults, n = Faults(flip=0.01), len(reader.samples)
    state = reader.wait(lambda state, samples: len(samples) >= n + 5)
    assert wrong(reader, wire) == [] and state.counts.crc_errors > 20
    wire.faults = Faults()
    reader.wait(lambda state, samples: len(samples) >= n + 60)
    assert wrong(reader, wire) == []
    tell(
        "1 % of the bits flipped, on the line",
        f"{state.counts.crc_errors} corrupted lines seen and dropped; 0 wrong",
    )


def test_one_percent_flipped_bits_in_many_lines(tell):
    rng, many, part = np.random.default_rng(1), 400_000, 20_000
    decoder = McuDecoder(RATE_HZ)
    believed = corrupted = 0
    for first in range(0, many, part):
        sent = lines(part, rng, first)
        received = flipped(sent, rng, 0.01)
        corrupted += int((sent != received).any(1).sum())
        said = set(map(bytes, sent))
        for sample in decode(decoder, received, first):
            assert as_sent(sample) in said
            believed += 1
    assert believed >= 0.99 * (many - corrupted)
    tell(
        "1 % of the bits flipped, 400,000 lines",
        f"{corrupted} corrupted, 0 of them believed; of the {many - corrupted} sound ones {believed} were",
    )


def test_what_a_checksum_lets_pass(tell):
    """One line in seven with 2 to 6 digits replaced and the right checksum of that."""
    rng = np.random.default_rng(2)
    sent = lines(70_000, rng)
    received = sent.copy()
    which = np.arange(3, len(sent), 7)
    received[which] = forged(sent[which], rng)
    wrong_lines = (received != sent).any(1).sum()
    said = set(map(bytes, sent))
    decoder = McuDecoder(RATE_HZ)
    samples = list(decode(decoder, received))
    codes = np.array([(s.x, s.y) for s in samples if as_sent(s) not in said]) - 0x812345
    far = np.abs(codes).max(1) > 0.05 / 76 * 2**24 * 2
    share = len(codes) / wrong_lines
    assert share < 0.06 and not far.any()
    assert len(samples) - len(codes) >= 0.99 * (len(sent) - wrong_lines)
    assert decoder.counts.restarts == 0
    tell(
        "wrong lines with the right checksum",
        f"{wrong_lines} made, {100 * share:.1f} % believed: at their time and within 0.05 deg of the samples around them",
    )


def values(**changed):
    return defaults_of("inclinometer") | changed


class Taken:
    """A source of the microcontroller, and its readings."""

    def __init__(self, path, now_ns=time.time_ns, **parameters):
        self.readings = []
        self._come = threading.Event()
        self.clock = HostClock(now_ns)
        host = Surroundings(None, self.clock, self._come.set)
        self.source = McuSource(host, values(port=path, **parameters))
        self.source.start()

    def until(self, condition):
        while not condition():
            assert self._come.wait(WAIT_S), self.source.health()
            self._come.clear()
            self.readings += self.source.fetch()


def test_converter_frozen(board, wire, node, ears, tell):
    process = node(f"port:={wire.path}", "rate:=50")
    ears.wait(lambda: len(ears.tilts) >= 50)
    n = len(ears.tilts)
    board.tell("freeze 1")
    frozen = time.monotonic()
    told_s = ears.told(frozen, 2, "stuck")

    # It is chance which of the two topics comes first.
    def flagged():
        return [at for at, t in zip(ears.times[n:], ears.tilts[n:], strict=False) if t.flags & Tilt.STUCK]

    ears.wait(flagged)
    flagged_s = flagged()[0] - frozen
    board.tell("freeze 0")
    ears.wait(lambda: ears.tilts[-1].flags == 0)
    assert ears.wrong() == 0 and process.end(signal.SIGTERM)[0] == 0
    tell(
        "converter frozen",
        f"flagged STUCK after {flagged_s:.2f} s, in diagnostics after {told_s:.1f} s; 0 wrong, before and after",
    )


def dated(taken) -> list:
    """The readings from the first one on whose time is known."""
    return list(dropwhile(lambda r: r.flags & TIME_UNKNOWN, taken.readings))


@pytest.mark.parametrize("step_s", [2.0, -2.0])
def test_host_clock_stepped(wire, tell, step_s):
    ahead_s = [0.0]
    taken = Taken(wire.path, lambda: time.time_ns() + round(ahead_s[0] * 1e9), rate=50)
    try:
        taken.until(lambda: len(dated(taken)) >= 60)
        assert taken.clock.step is None
        ahead_s[0] = step_s
        n = len(dated(taken))
        taken.until(lambda: len(dated(taken)) >= n + 60)
        health, step = taken.source.health(), taken.clock.step
    finally:
        taken.source.stop()
    steps = np.diff([r.stamp_ns for r in dated(taken)[-120:]]) * 1e-9
    largest = np.abs(steps - 0.02).argmax()
    assert steps[largest] == pytest.approx(0.02 + step_s, abs=0.03)
    assert np.abs(np.delete(steps, largest) - 0.02).max() < 0.03
    assert np.diff([r.sequence for r in taken.readings]).tolist() == [1] * (len(taken.readings) - 1)
    assert {r.flags for r in dated(taken)} == {0}
    assert health.phase is Phase.RECEIVING and step.seconds == pytest.approx(step_s, abs=0.01)
    reporter = Reporter()
    during = reporter.report(health, step, step.monotonic_s + 29)
    after = reporter.report(health, step, step.monotonic_s + 31)
    assert (during.level, after.level) == (1, 0) and f"{step_s:+.3f} s" in during.message
    tell(
        f"host's clock stepped by {step_s:+.0f} s",
        f"told as {step.seconds:+.3f} s; stamps of the new time from the next sample on, "
        f"each {np.delete(steps, largest).mean() * 1e3:.1f} ms after the one before",
    )


def test_two_processes_on_one_port(wire, node, ears, read, tell):
    reader = read(wire.path)
    reader.wait(lambda state, samples: len(samples) >= 20)
    begun = time.monotonic()
    process = node(f"port:={wire.path}")
    ears.told(begun, 2, "in use by another process")
    n = len(reader.samples)
    reader.wait(lambda state, samples: len(samples) >= n + 50)
    assert not ears.tilts and wrong(reader, wire) == []
    lost = reader.link.health().counts
    assert (lost.lost, lost.crc_errors) == (0, 0)
    reader.link.stop()
    ears.wait(lambda: len(ears.tilts) >= 20)
    assert ears.wrong() == 0 and process.end(signal.SIGTERM)[0] == 0
    tell(
        "two processes on one port",
        "the second says that it is in use, the first loses nothing; the second begins when the first has ended",
    )


def test_the_sensor_does_not_answer(board, wire, tell):
    """Without its temperature the tilt of a compensated sensor is less well known, and says so."""
    # So much that its age outweighs the noise, which is estimated anew meanwhile.
    volts_per_c = 2e-3
    compensated = {"temperature.offset_x": (volts_per_c, 0.0, 0.0)}
    taken = Taken(wire.path, rate=50, **compensated)
    try:
        taken.until(lambda: len(taken.readings) >= 100)
        # of the one whose temperature was the newest
        before = math.sqrt(min(r.covariance[0] for r in taken.readings))
        board.tell("sensor 0")
        taken.until(lambda: math.isnan(taken.readings[-1].temperature_c))
        n = len(taken.readings)
        taken.until(lambda: len(taken.readings) >= n + 200)
        after = math.sqrt(taken.readings[-1].covariance[0])
    finally:
        taken.source.stop()
    error = math.degrees(abs(taken.readings[-1].x - taken.readings[n - 1].x))
    assert error < NEAR_DEG and not any(r.flags & STUCK for r in taken.readings)
    aged = math.hypot(before, 4.0 * 2.0 / 60 * volts_per_c / 4)
    assert after > 1.05 * before and after == pytest.approx(aged, rel=0.3)
    tell(
        "sensor's temperature missing, 2 mV/deg C compensated",
        f"the last one is kept, NaN published; 1 sigma from {math.degrees(before) * 3600:.1f} to "
        f"{math.degrees(after) * 3600:.1f} arcsec in 4 s",
    )


def test_lines_of_nonsense_with_the_right_checksum(tell):
    """Every field at random but the status."""
    rng = np.random.default_rng(3)
    decoder = McuDecoder(RATE_HZ)
    nonsense = 100_000
    fields = rng.integers(0, 256, (nonsense, 13), np.uint8)
    stream = []
    for row in fields:
        h = row.tobytes().hex().upper()
        body = f"T,{h[:4]},{h[4:12]},{h[12:18]},{h[18:24]},{h[24:26]},00"
        stream.append(mcu_protocol.frame(body.encode()))
    received = np.frombuffer(b"".join(stream), np.uint8).reshape(nonsense, -1)
    believed = list(decode(decoder, received))
    assert believed == []
    tell("lines of nonsense with the right checksum", f"{nonsense} made, {len(believed)} believed")

# SPDX-License-Identifier: Apache-2.0
"""Edges of the shutter and of a receiver's second: timed by the firmware of both boards, dated by the driver."""

from dataclasses import asdict

import numpy as np
import pytest
from board import Board
from reader import mcu_source

from starpos.parameters.table import defaults_of
from starpos_common.shutter_pulses import Edge, ShutterPulse, ShutterPulses
from starpos_inclinometer.clock import Moment
from starpos_inclinometer.sources.mcu import LINE_STDDEV_S, SECOND_STDDEV_S, McuDecoder, PulseTimes
from starpos_inclinometer.sources.mcu_protocol import Input, LineParser, Pulse, Sample, frame
from starpos_testing import emulator

VALUES = defaults_of("inclinometer")
BOOT_MS = 600


@pytest.fixture(params=["paper", "nano"])
def board(request, built):
    board = Board(built, board=request.param)
    board.connect()
    yield board
    assert board.close() == ""


def ns(message):
    """The stamp of a message."""
    return message.header.stamp.sec * 10**9 + message.header.stamp.nanosec


def pulses(messages):
    return [m for m in messages if isinstance(m, Pulse)]


def time_ms(pulse):
    return pulse.milliseconds + pulse.microseconds * 1e-3


def test_a_contact_that_bounces_gives_its_first_edge_to_the_microsecond_and_its_last(board):
    """The rests of a millisecond at which it closes and opens go through the whole timer."""
    board.run(BOOT_MS)
    got, expected = [], []
    for k in range(40):
        begin_ms = board.tell("state")["ms"]
        after_ms = 3 + k * 0.1013
        board.tell(f"shutter {after_ms} {100 + k * 0.37} {k % 4}")
        # each bounce takes 0.4 ms
        expected += [begin_ms + after_ms, begin_ms + after_ms + 0.4 * (k % 4) + 100 + k * 0.37]
        got += pulses(board.messages(170))
    assert [p.rising for p in got] == [False, True] * 40
    assert [p.number for p in got] == list(range(80))
    assert {p.input for p in got} == {Input.SHUTTER}
    # all edges of the bounces, reported with the edge that ends the pulse
    assert [p.bounces for p in got[1::2]] == [2 * (k % 4) for k in range(40)]
    errors = np.array([time_ms(p) for p in got]) - expected
    # the MCU's clock begins a little after its reset
    assert 0 <= -errors.mean() < 0.3 and np.ptp(errors) < 0.003


def test_an_edge_beside_the_end_of_a_millisecond_costs_none(board):
    """The timer wraps while the edge's handler runs: the millisecond is counted, once, and the clock goes on."""
    board.run(BOOT_MS)
    board.tell("shutter 5 20")
    first = pulses(board.messages(120))[0]
    # of the MCU's clock against its reset
    off_ms = time_ms(first) - (board.tell("state")["ms"] - 120 + 5)
    errors = []
    for k in range(-12, 20):
        now_ms = board.tell("state")["ms"]
        after_ms = 8 - (now_ms + off_ms) % 1 + k * 0.0005
        board.tell(f"shutter {after_ms:.6f} 20")
        closed, opened = pulses(board.messages(80))
        errors += [
            time_ms(closed) - off_ms - now_ms - after_ms,
            time_ms(opened) - off_ms - now_ms - after_ms - 20,
        ]
    assert np.abs(errors).max() < 0.003 and board.parser.counts.malformed == 0


def test_a_receivers_second_is_timed_beside_samples_and_shutter(board):
    board.run(BOOT_MS)
    begin_ms = board.tell("state")["ms"]
    board.tell("pps 20.25 1000")
    board.tell("shutter 20.25 300 1")
    got = board.messages(3500)
    seconds = [p for p in pulses(got) if p.input == Input.PPS]
    assert [p.rising for p in seconds] == [True] * 4 and [p.number for p in seconds] == [0, 1, 2, 3]
    errors = np.array([time_ms(p) - 1000 * k for k, p in enumerate(seconds)]) - begin_ms - 20.25
    assert errors.min() > -0.3 and np.ptp(errors) < 0.02
    # both at once: the shutter's is captured by the timer
    shutter = [p for p in pulses(got) if p.input == Input.SHUTTER]
    assert time_ms(shutter[0]) == pytest.approx(time_ms(seconds[0]), abs=0.02) and len(shutter) == 2
    assert sum(isinstance(m, Sample) and not m.status for m in got) >= 34
    assert (board.parser.counts.crc_errors, board.parser.counts.malformed) == (0, 0)


def test_a_strobe_of_microseconds_is_one_edge_each_time(board):
    board.run(BOOT_MS)
    got = []
    for _ in range(5):
        board.tell("shutter 5 0.02")
        got += pulses(board.messages(100))
    # its end is a bounce, or shorter than the handler takes
    assert [p.rising for p in got] == [False] * 5 and all(p.bounces < 2 for p in got)


def test_more_edges_than_wait_for_the_line_are_missed_by_their_numbers(board):
    """At 50 Hz the line has room for 50 edges a second; these are 250."""
    board.run(BOOT_MS)
    board.messages(30, b"$R,32*0000\r\n")
    got = []
    for _ in range(100):
        board.tell("shutter 0.1 4")
        got += pulses(board.messages(8))
    got += pulses(board.messages(300))
    assert 20 < len(got) < 200 and not any(p.bounces for p in got)
    board.tell("shutter 5 30")
    assert [p.number for p in pulses(board.messages(200))] == [200, 201]


def test_lines_of_edges_are_read_as_they_are_written():
    most = {"number": 255, "bounces": 3, "milliseconds": 0xFFFFFFFF, "microseconds": 999}
    sent = [Pulse(input=i, rising=r, **most) for i in (0, 1) for r in (False, True)]
    parser = LineParser()
    lines = [
        emulator.pulse_line(channel=p.input, **{k: v for k, v in asdict(p).items() if k != "input"})
        for p in sent
    ]
    assert parser.parse(b"".join(lines)) == sent
    bad = [b"P,02,00,00,00000000,0000", b"P,00,00,00,00000000,03E8", b"P,0,00,00,00000000,0000"]
    assert parser.parse(b"".join(map(frame, bad))) == [] and parser.counts.malformed == 3


class Line:
    """A board with a resonator that is off, behind a line that delays; its host's clock is off too."""

    def __init__(self, rate=1.004, off_s=0.12, seed=1):
        self.rate, self.off_s = rate, off_s
        self.rng = np.random.default_rng(seed)
        self.times = PulseTimes()
        self.numbers = [0, 0]

    def edge(self, input_, utc_s, rising=False):
        us = round((utc_s - 1.7e9 + 5) * self.rate * 1e6)
        pulse = Pulse(
            input=input_,
            rising=rising,
            number=self.numbers[input_] & 0xFF,
            bounces=0,
            milliseconds=us // 1000,
            microseconds=us % 1000,
        )
        self.numbers[input_] += 1
        arrival_s = utc_s - 1.7e9 + self.rng.uniform(0.01, 0.03)
        moment = Moment(arrival_s, round((1.7e9 + arrival_s + self.off_s) * 1e9))
        known_s = utc_s - 1.7e9 + self.rng.uniform(0, 0.016) - (us % 1000) * 1e-6
        self.times.date(pulse, moment, known_s)
        return self.times.fetch()


def test_by_the_receivers_second_an_edge_has_utc_whatever_the_line_and_the_hosts_clock_add():
    line, errors = Line(), []
    for k in range(60):
        line.edge(Input.PPS, 1.7e9 + k, rising=True)
        utc_s = 1.7e9 + k + line.rng.uniform(0.1, 0.9)
        (timed,) = line.edge(Input.SHUTTER, utc_s)
        # two pulses relate the clocks
        assert timed.disciplined == (k > 0)
        if timed.disciplined:
            errors.append(ns(timed) * 1e-9 - utc_s)
            assert timed.stamp_stddev == SECOND_STDDEV_S
        else:
            assert timed.stamp_stddev == LINE_STDDEV_S and abs(ns(timed) * 1e-9 - utc_s - 0.12) < 0.02
    assert np.abs(errors).max() < 1e-5


def test_a_second_that_nobody_can_number_and_spurious_or_missing_pulses_give_no_wrong_time():
    off = Line(off_s=0.4)
    for k in range(5):
        off.edge(Input.PPS, 1.7e9 + k)
        (timed,) = off.edge(Input.SHUTTER, 1.7e9 + k + 0.5)
        assert not timed.disciplined
    assert "set it" in off.times.second
    line, disciplined = Line(seed=2), 0
    for k in range(300):
        if line.rng.random() > 0.1:
            line.edge(Input.PPS, 1.7e9 + k)
        if line.rng.random() < 0.1:
            line.edge(Input.PPS, 1.7e9 + k + line.rng.uniform(0.02, 0.45))
        utc_s = 1.7e9 + k + line.rng.uniform(0.5, 0.9)
        (timed,) = line.edge(Input.SHUTTER, utc_s)
        if timed.disciplined:
            disciplined += 1
            assert abs(ns(timed) * 1e-9 - utc_s) < 1e-4
    assert disciplined > 150
    line.times.restart()
    (timed,) = line.edge(Input.SHUTTER, 1.7e9 + 300)
    assert not timed.disciplined


def test_the_numbers_of_edges_go_on_over_their_wrap_and_tell_of_lost_ones():
    times = PulseTimes()
    for number in (254, 255, 0, 2):
        pulse = Pulse(input=0, rising=False, number=number, bounces=0, milliseconds=0, microseconds=0)
        times.date(pulse, Moment(10, 10**10), 9.9)
    assert [t.sequence for t in times.fetch()] == [0, 1, 2, 4]


def test_a_night_of_frames_has_the_times_of_their_light_though_nobody_stated_the_cameras_lag(board):
    """From the contact through board, line, driver and pairing: 0.1 ms are 5 cm of longitude, the lag's 0.3 s 139 m."""
    rng, exposure_s, off_s = np.random.default_rng(1), 0.3, 0.015
    decoder, tilts, pairing = McuDecoder(10), mcu_source(VALUES), ShutterPulses()
    board.run(BOOT_MS)
    # the first pulse of the receiver is the second 1.7e9
    zero_ms = board.tell("pps 100 1000")["ms"] + 100
    utc_s = lambda ms: 1.7e9 + (ms - zero_ms) * 1e-3  # noqa: E731
    errors = []
    for k in range(24):
        now_ms = board.tell("state")["ms"]
        commanded_s = utc_s(now_ms) + off_s
        lag_s = 0.3 + rng.normal(0, 0.004)
        board.tell(f"shutter {lag_s * 1e3} {exposure_s * 1e3} 0")
        for _ in range(16):
            data = board.run(50, decoder.command() if k < 2 else b"")
            read_ms = board.tell("state")["ms"]
            host_ns = round((utc_s(read_ms) + off_s) * 1e9)
            tilts.read(decoder.decode(data, Moment(read_ms * 1e-3, host_ns)))
            for t in tilts.pulses.fetch():
                if t.input == Input.SHUTTER:
                    edge = Edge(
                        time_s=ns(t) * 1e-9,
                        stddev_s=t.stamp_stddev,
                        rising=t.rising,
                        sequence=t.sequence,
                        disciplined=t.disciplined,
                    )
                    pairing.record(edge)
        got = pairing.pair(commanded_s, exposure_s, commanded_s, host_ns * 1e-9)
        if isinstance(got, ShutterPulse):
            assert got.disciplined
            errors.append(got.begin_s - utc_s(now_ms) - lag_s)
    assert len(errors) >= 12 and np.abs(errors).max() < 1e-4
    # against the host's clock, which is off by what the lag then holds too
    assert pairing.lag.median_s == pytest.approx(0.3 - off_s, abs=0.004)


def test_edges_go_through_the_driver_with_the_relation_that_the_samples_showed(board):
    """The board's own bytes, each read when it came; the edge's time is good to the lines' jitter."""
    decoder, tilts = McuDecoder(10), mcu_source(VALUES)
    got, told = [], []
    for k in range(40):
        if k == 25:
            told.append(board.tell("state")["ms"] * 1e-3 + 0.0505)
            board.tell("shutter 50.5 30")
        data = board.run(100, decoder.command() if k < 4 else b"")
        now_s = board.tell("state")["ms"] * 1e-3
        moment = Moment(now_s, round(now_s * 1e9) + 10**18)
        tilts.read(decoder.decode(data, moment))
        got += tilts.pulses.fetch()
    assert tilts.pulses.undated == 0 and [t.rising for t in got] == [False, True]
    # read every 0.1 s, so the earliest lines came up to that late
    assert -0.02 < (ns(got[0]) - 10**18) * 1e-9 - told[0] < 0.12
    assert got[1].device_time - got[0].device_time == pytest.approx(0.030, abs=1e-5)

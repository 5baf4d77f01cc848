# SPDX-License-Identifier: Apache-2.0
"""The driver and the node on the firmware's line in real time, as they would be on the device's."""

import math
import signal

import pytest
from board import Board
from diagnostic_msgs.msg import DiagnosticArray

from starpos_inclinometer.sources.source import Phase
from starpos_interfaces.msg import Pulse, Tilt
from starpos_testing.nodes import Listener, Process, take_domain

TILT_DEG = (3.0, -11.0)


@pytest.fixture(scope="module", autouse=True)
def domain():
    take_domain()


@pytest.fixture
def board(built):
    board = Board(built, "--unit", "2A", "--tilt", *map(str, TILT_DEG), speed=1)
    yield board
    assert board.close() == ""


def test_the_link_sets_the_rate_and_sees_a_stuck_converter(board, read):
    reader = read(board.path, rate_hz=50)
    state = reader.wait(lambda state, samples: len(samples) >= 40 and reader.identity is not None)
    assert (state.phase, reader.identity.unit, reader.identity.rate_hz) == (Phase.RECEIVING, 0x2A, 50)
    reader.decoder.wanted_rate_hz = 20
    reader.wait(lambda state, samples: reader.identity.rate_hz == 20)
    board.tell("freeze 1")
    reader.wait(lambda state, samples: samples[-1].sample.status == 1)
    board.tell("freeze 0")
    state = reader.wait(lambda state, samples: samples[-1].sample.status == 0)
    assert state.counts.crc_errors == state.counts.malformed == state.counts.lost == 0
    assert (state.counts.restarts, state.counts.implausible, state.values["unfetched samples"]) == (0, 0, 0)


def test_the_node_publishes_the_tilt_of_the_device(board):
    listener = Listener()
    tilts = listener.hear(Tilt, "tilt", 100)
    pulses = listener.hear(Pulse, "pulses", 100)
    reports = listener.hear(DiagnosticArray, "/diagnostics")

    def report():
        return next(s for s in reversed(reports[-1].status) if s.name == "inclinometer: Link")

    node = Process("starpos_inclinometer.main", "inclinometer", [f"port:={board.path}", "rate:=50"])
    try:
        # the first second after the start, and after the change of rate, is not dated
        listener.wait(lambda: len(tilts) >= 100 and not any(t.flags for t in tilts[-50:]))
        n = len(tilts)
        mean = [math.degrees(sum(getattr(t, axis) for t in tilts) / n) for axis in "xy"]
        # Neighbours share the sensor's noise, which is of 18 Hz: about every second one is independent.
        assert mean == pytest.approx(TILT_DEG, abs=4 * 0.0042 / math.sqrt(n / 2))
        assert {t.flags & ~Tilt.TIME_UNKNOWN for t in tilts[1:]} == {0}
        assert tilts[-1].temperature == pytest.approx(20, abs=0.5)
        stamps = [t.header.stamp.sec + t.header.stamp.nanosec * 1e-9 for t in tilts[-50:]]
        assert (stamps[-1] - stamps[0]) / 49 == pytest.approx(0.02, abs=0.0005)
        listener.wait(lambda: reports and report().level == b"\x00")
        values = {v.key: v.value for v in report().values}
        assert (values["unit"], values["firmware"], values["checksum errors"]) == ("0000002A", "2.0", "0")
        board.tell("shutter 5 40 1")
        listener.wait(lambda: len(pulses) == 2)
        assert [(p.input, p.rising, p.disciplined) for p in pulses] == [
            (Pulse.SHUTTER, False, False),
            (Pulse.SHUTTER, True, False),
        ]
        assert pulses[1].device_time - pulses[0].device_time == pytest.approx(0.0404, abs=1e-3)
        stamps = [p.header.stamp.sec + p.header.stamp.nanosec * 1e-9 for p in pulses]
        assert stamps[1] - stamps[0] == pytest.approx(0.0404, abs=0.002)
        board.tell("reference 0")
        listener.wait(lambda: tilts[-1].flags & Tilt.STUCK and report().level == b"\x02")
        board.tell("reference 1")
        listener.wait(lambda: tilts[-1].flags == 0 and report().level == b"\x00")
        assert node.end(signal.SIGTERM)[0] == 0
    finally:
        node.kill()
        listener.close()

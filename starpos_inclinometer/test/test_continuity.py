# SPDX-License-Identifier: Apache-2.0
"""Which samples are believed, and what is known to be lost, whatever a line leaves of them."""

import numpy as np
import pytest

from starpos_inclinometer.clock import Moment
from starpos_inclinometer.sources import mcu_protocol
from starpos_inclinometer.sources.mcu import NEAR_CODES, McuDecoder
from starpos_inclinometer.sources.mcu_protocol import SampleStatus, SensorKind
from starpos_testing import emulator

CODE = 0x812345


def line(sequence, ms=None, x=CODE, y=CODE, status=0):
    return emulator.sample_line(sequence, 100 * sequence if ms is None else ms, x, y, 175, status)


def identity(rate_hz=10):
    return emulator.identity_line(rate_hz, 14)


class Line:
    """A decoder fed line by line, 0.1 s apart by default."""

    def __init__(self):
        self.decoder = McuDecoder(10)
        self.now_s = 100.0
        self.decoder.decode(identity(), Moment(self.now_s, 0))

    def send(self, *lines, apart_s=0.1):
        got = []
        for data in lines:
            self.now_s += apart_s
            got += [a.sample for a in self.decoder.decode(data, Moment(self.now_s, 0))]
        return got

    @property
    def counts(self):
        return self.decoder.counts


@pytest.fixture
def cable():
    return Line()


def numbers(samples):
    return [s.sequence for s in samples]


def test_the_first_sample_waits_for_a_second_one(cable):
    assert cable.send(line(0)) == []
    assert numbers(cable.send(line(1))) == [0, 1]
    assert numbers(cable.send(line(2))) == [2]


def test_a_fault_is_told_at_once_its_end_when_it_is_said_twice(cable):
    cable.send(line(0), line(1))
    got = cable.send(line(2, status=SampleStatus.NO_ANSWER), line(3, status=SampleStatus.NO_ANSWER))
    assert numbers(got) == [2, 3]
    assert cable.send(line(4)) == [] and numbers(cable.send(line(5))) == [4, 5]


def test_without_temperature_its_number_means_nothing(cable):
    cable.send(line(0), line(1))
    odd = emulator.sample_line(2, 200, CODE, CODE, 0xFF, SampleStatus.NO_TEMPERATURE)
    assert numbers(cable.send(odd, line(3))) == [2, 3]


@pytest.mark.parametrize(
    "wrong",
    [
        emulator.sample_line(3, 300, CODE, CODE, 0xAF ^ 0x40, 0),
        line(3, x=CODE + 4 * NEAR_CODES[SensorKind.SCA100T]),
        line(3, y=0xFFFFFF),
        line(3, ms=350),
        line(3, ms=3000),
        line(0xF003, ms=300),
        line(1, ms=100, x=CODE + 1),
        line(0, ms=300, status=SampleStatus.FIRST),
        line(0x0103, ms=0x103 * 100),
    ],
)
def test_a_sample_that_nothing_bears_out_is_dropped(cable, wrong):
    cable.send(line(0), line(1), line(2))
    assert cable.send(wrong) == []
    assert numbers(cable.send(line(4), identity(), line(5))) == [4, 5]
    assert cable.counts.implausible == 1


def test_a_tilt_that_leaps_is_believed_with_the_next_sample(cable):
    cable.send(line(0), line(1))
    assert cable.send(line(2, x=CODE + 10**6)) == []
    assert numbers(cable.send(line(3, x=CODE + 10**6 + 5))) == [2, 3]
    assert cable.counts.implausible == 0


def test_a_tilt_that_moves_on_and_on_is_followed(cable):
    """It is followed from the beginning, when no sample is known to be sound."""
    moving = [line(k, x=CODE + 200_000 * k) for k in range(20)]
    assert numbers(cable.send(*moving)) == list(range(20))
    assert cable.counts.implausible == 0


def test_nothing_of_a_shaken_instrument_is_dropped(cable):
    codes = (CODE + 300_000 * np.random.default_rng(1).standard_normal(400)).astype(int).tolist()
    got = cable.send(*(line(k, x=code) for k, code in enumerate(codes)))
    assert cable.counts.implausible <= 3 and len(got) >= 395


def test_one_wrong_code_does_not_open_the_gate_for_the_next(cable):
    cable.send(*(line(k) for k in range(30)))
    for k in range(30, 130, 2):
        assert cable.send(line(k, x=CODE ^ 0x100000)) == []
        assert len(cable.send(line(k + 1))) == 1
    assert cable.counts.implausible == 50


def test_a_leap_does_not_open_the_gate_for_what_comes_after(cable):
    cable.send(*(line(k) for k in range(30)))
    far = CODE + 4_000_000
    assert numbers(cable.send(line(30, x=far), line(31, x=far))) == [30, 31]
    assert cable.send(line(32, x=far - 500_000)) == [] and numbers(cable.send(line(33, x=far))) == [33]


def test_after_a_rejection_the_rate_is_asked_for_again(cable):
    """The MCU was reset to 10 Hz, and of what it said then nothing came through but samples."""
    cable.decoder.wanted_rate_hz = 50
    cable.decoder.decode(identity(50), Moment(100.0, 0))
    cable.send(*(line(k, ms=20 * k) for k in range(5)), apart_s=0.02)
    assert cable.decoder.command() == b""
    assert cable.send(*(line(k) for k in range(7, 12))) == []
    assert cable.decoder.command() == mcu_protocol.identify_command()
    assert numbers(cable.send(identity(), line(12), line(13))) and cable.counts.restarts <= 1


def test_a_host_that_stalled_loses_nothing(cable):
    got = cable.send(*(line(k) for k in range(5)))
    got += cable.send(line(5), apart_s=2.5)
    got += cable.send(*(line(k) for k in range(6, 30)), apart_s=0.0)
    got += cable.send(line(30), apart_s=0.0)
    assert numbers(got) == list(range(31))


def test_lost_doubled_and_wrapped_sequence(cable):
    start = 0xFFFC
    sent = [line(start + k) for k in (0, 0, 1, 4, 5, 6, 7)]
    got = cable.send(*sent, apart_s=0.1)
    assert [s.lost for s in got] == [0, 0, 2, 0, 0, 0]
    assert np.diff(numbers(got)).tolist() == [1, 3, 1, 1, 1]
    assert (cable.counts.lost, cable.counts.duplicates, cable.counts.implausible) == (2, 1, 0)


def test_millisecond_wrap_is_no_reset_but_going_back_is(cable):
    first = [line(6, 0xFFFFFF8C), line(7, 0xFFFFFFF0)]
    wrapped = [line(8, 84)]
    reset = [line(0, 10, status=SampleStatus.FIRST | SampleStatus.WATCHDOG), line(1, 110)]
    unannounced = [line(0, 5), line(1, 105)]
    got = cable.send(*first, *wrapped, *reset, identity(), *unannounced)
    assert [s.broken for s in got] == [False, False, False, True, False, True, False]
    assert np.diff(numbers(got)).tolist() == [1] * 6
    assert (cable.counts.restarts, cable.counts.lost, cable.counts.implausible) == (2, 0, 0)


def test_the_first_sample_of_a_new_connection_claims_no_continuity(cable):
    """The MCU may have been reset unnoticed, and by chance go on where it was."""
    got = cable.send(line(0), line(1), line(2)[:9])
    cable.decoder.resume()
    assert cable.send(line(2)) == []
    got += cable.send(line(3))
    assert [s.broken for s in got] == [False, False, True, False]
    assert numbers(got) == [0, 1, 2, 3]
    assert (cable.counts.lost, cable.counts.garbage_bytes) == (0, 9)

# SPDX-License-Identifier: Apache-2.0
"""The link and the emulated device on a real pseudo-terminal: cables pulled, faults, resets, two readers."""

import os
import threading
import time

import pytest

from starpos_inclinometer.emulator import Faults, Mcu
from starpos_inclinometer.link import LinkState, Phase, SerialLink

WAIT_S = 10.0


class Reader:
    """A link, and what came out of it; waits for events instead of sleeping."""

    def __init__(self, path, rate_hz=50):
        self.samples = []
        self._event = threading.Condition()
        self.link = SerialLink(path, rate_hz, wake=self._wake)
        self.link.start()

    def _wake(self):
        with self._event:
            self.samples += self.link.take()
            self._event.notify_all()

    def wait(self, condition) -> LinkState:
        """The state, once condition(state, samples) is true."""
        with self._event:
            met = self._event.wait_for(lambda: condition(self.link.state(), self.samples), WAIT_S)
        state = self.link.state()
        assert met, state
        return state


@pytest.fixture
def read(bench):
    readers = []

    def make(**options):
        readers.append(Reader(bench.path, **options))
        return readers[-1]

    yield make
    for reader in readers:
        reader.link.stop()
        assert not reader.link._thread.is_alive()


def test_samples_identity_and_rate(bench, read):
    bench.plug(Mcu(lambda now: (0.1, -0.2), seed=1, rate_hz=10))
    reader = read(rate_hz=50)
    state = reader.wait(lambda state, samples: len(samples) >= 30)
    assert state.phase is Phase.RECEIVING
    assert state.identity.rate_hz == 50 and state.identity.version == 1
    reader.wait(lambda state, samples: state.rate_hz > 40)
    codes = [a.sample.x for a in reader.samples]
    assert len(set(codes)) > 1
    reader.link.set_rate(20)
    reader.wait(lambda state, samples: state.identity and state.identity.rate_hz == 20)


def test_port_that_is_not_there_then_is_then_goes_and_comes_back(bench, read):
    reader = read()
    state = reader.wait(lambda state, samples: "not there" in state.sentence)
    assert state.phase is Phase.ABSENT and bench.path in state.sentence
    for turn in (1, 2):
        before = len(reader.samples)
        bench.plug(Mcu(seed=turn))
        plugged = time.monotonic()
        reader.wait(
            lambda state, samples, n=before: state.phase is Phase.RECEIVING and len(samples) >= n + 10
        )
        assert reader.samples[before].monotonic_s - plugged < WAIT_S
        bench.unplug()
        state = reader.wait(lambda state, samples: state.phase is Phase.ABSENT)
        assert state.connections == turn
        assert state.identity is None
    assert state.counts.restarts == 1


def test_faults_are_counted_and_no_wrong_sample_passes(bench, read):
    faults = Faults(garbage=0.1, drop=0.05, truncate=0.05, double=0.1, flip=0.0005)
    bench.plug(Mcu(lambda now: (0.1, -0.2), noise_rad=0.0, seed=1, rate_hz=50), faults=faults)
    reader = read(rate_hz=50)
    state = reader.wait(lambda state, samples: len(samples) >= 150)
    assert (
        state.counts.crc_errors
        and state.counts.lost
        and state.counts.duplicates
        and state.counts.garbage_bytes
    )
    x, y = reader.samples[0].sample.x, reader.samples[0].sample.y
    assert all(abs(a.sample.x - x) < 500 and abs(a.sample.y - y) < 500 for a in reader.samples)
    sequence = [a.sample.sequence for a in reader.samples]
    assert sequence == sorted(set(sequence))


def test_mcu_reset_is_seen_and_the_rate_set_again(bench, read):
    bench.plug(Mcu(seed=1, rate_hz=10), reset_every_s=1.5)
    reader = read(rate_hz=50)
    state = reader.wait(
        lambda state, samples: state.counts.restarts >= 1 and state.identity and state.identity.rate_hz == 50
    )
    assert state.phase is Phase.RECEIVING and state.connections == 1


def test_second_reader_is_told_that_the_port_is_in_use(bench, read):
    bench.plug()
    first = read()
    first.wait(lambda state, samples: samples)
    second = read()
    second.wait(lambda state, samples: "in use" in state.sentence)
    before = len(first.samples)
    first.wait(lambda state, samples: len(samples) > before)
    assert not second.samples


def test_silent_device_and_wrong_device(bench, read):
    master, slave = os.openpty()
    os.symlink(os.ttyname(slave), bench.path)
    stop = threading.Event()

    def chatter():
        while not stop.wait(0.05):
            os.write(master, b"$GPGGA,123519,4807.038,N*47\r\n")

    reader = read()
    try:
        reader.wait(lambda state, samples: state.phase is Phase.SILENT and "silent" in state.sentence)
        thread = threading.Thread(target=chatter)
        thread.start()
        reader.wait(lambda state, samples: state.phase is Phase.GARBLED and "baud" in state.sentence)
    finally:
        stop.set()
        thread.join()
        reader.link.stop()
        os.close(master)
        os.close(slave)


def test_path_that_leads_to_another_device_is_followed(bench, read):
    """The old device says no more but its port stays open, as with a hub that lost power downstream."""
    master, slave = os.openpty()
    os.symlink(os.ttyname(slave), bench.path)
    reader = read()
    reader.wait(lambda state, samples: state.phase is Phase.SILENT)
    bench.plug()
    reader.wait(lambda state, samples: samples)
    os.close(master)
    os.close(slave)


def test_what_is_no_serial_port_is_said(bench, read):
    with open(bench.path, "w") as file:
        file.write("hello")
    state = read().wait(lambda state, samples: "no usable serial port" in state.sentence)
    assert "\n" not in state.sentence

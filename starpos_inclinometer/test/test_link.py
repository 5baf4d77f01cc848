# SPDX-License-Identifier: Apache-2.0
"""The link and the emulated device on a real pseudo-terminal: openings, rates, silence, wrong devices."""

import os
import subprocess
import threading

import pytest

from starpos_inclinometer.sources import serial_link
from starpos_inclinometer.sources.source import Phase, rate_of
from starpos_testing.emulator import Mcu

NOBODY = 65534


@pytest.mark.parametrize(
    ("times_s", "rate_hz"), [([], 0.0), ([7.0], 0.0), ([7.0, 7.0, 7.0], 0.0), ([0.0, 6.0, 6.5, 7.0], 2.0)]
)
def test_a_rate_is_of_the_last_seconds_and_no_time_is_no_rate(times_s, rate_hz):
    assert rate_of(times_s, 7.0) == rate_hz


def test_samples_identity_and_rate(bench, read):
    bench.plug(Mcu(lambda now: (0.1, -0.2), seed=1, rate_hz=10))
    reader = read(rate_hz=50)
    state = reader.wait(lambda state, samples: len(samples) >= 30)
    assert state.phase is Phase.RECEIVING
    assert reader.identity.rate_hz == 50 and reader.identity.version == 2
    reader.wait(lambda state, samples: state.rate_hz > 40)
    codes = [a.sample.x for a in reader.samples]
    assert len(set(codes)) > 1
    reader.decoder.wanted_rate_hz = 20
    reader.wait(lambda state, samples: reader.identity and reader.identity.rate_hz == 20)


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


def test_lines_that_never_fit_one_another_are_said(bench, read):
    """Right checksums, but each of another time: nothing of it is believed."""

    class Mad(Mcu):
        def sample(self):
            self._boot -= 777.0
            return super().sample()

    bench.plug(Mad(seed=1, rate_hz=50))
    reader = read()
    state = reader.wait(lambda state, samples: state.phase is Phase.GARBLED)
    assert "do not fit" in state.sentence and not reader.samples


@pytest.mark.parametrize("pseudo_terminal", [True, False])
def test_nobody_else_opens_the_port(bench, read, monkeypatch, pseudo_terminal):
    """`cat` and terminal programs ask for no lock. A pseudo-terminal stays open to all: here one is taken for a port."""
    if not pseudo_terminal:
        monkeypatch.setattr(serial_link, "PTY_MAJORS", ())
    bench.plug(Mcu(seed=1, rate_hz=50))
    read().wait(lambda state, samples: samples)
    port = os.path.realpath(bench.path)
    os.chmod(port, 0o666)
    # Root may always.
    other = {"user": NOBODY} if os.geteuid() == 0 else {}
    opened = subprocess.run(["sh", "-c", f": < {port}"], capture_output=True, text=True, check=False, **other)
    assert (opened.returncode == 0) == pseudo_terminal, opened.stderr
    assert pseudo_terminal or "busy" in opened.stderr

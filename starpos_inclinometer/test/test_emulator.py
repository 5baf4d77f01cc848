# SPDX-License-Identifier: Apache-2.0
"""The emulated MCU without a cable, and its executable."""

import math
import os
import signal
import subprocess
import sys

import numpy as np
import pytest

from starpos.messages.tilt import OUT_OF_RANGE, SATURATED
from starpos.parameters.table import defaults_of
from starpos_inclinometer.sources import mcu_protocol
from starpos_inclinometer.sources.mcu_protocol import Identity, LineParser, Reason, Refusal, SampleStatus
from starpos_inclinometer.sources.tilts import Sca100t
from starpos_testing.emulator import Mcu, Pty
from starpos_testing.patience import WAIT_S

COMMAND = [sys.executable, "-c", "import sys; from starpos_testing.emulator import main; sys.exit(main())"]


def readings(mcu, n):
    sensor, parser = Sca100t(defaults_of("inclinometer")), LineParser()
    return [
        sensor.measure(s, s.milliseconds * 1e-3)
        for s in parser.parse(b"".join(mcu.sample() for _ in range(n)))
    ]


def test_tilt_noise_and_temperature_come_back():
    tilt = np.radians([3.0, -20.0])
    got = readings(Mcu(lambda now: tilt, temperature_c=-10.0, seed=1), 2000)
    angles = np.array([(r.x, r.y) for r in got])
    sigma = math.radians(0.0035)
    assert np.abs(angles.mean(0) - tilt).max() < 4 * sigma / math.sqrt(2000)
    assert angles.std(0) == pytest.approx([sigma, sigma], rel=0.08)
    assert got[0].temperature_c == pytest.approx(-10.0, abs=0.47)
    assert {r.flags for r in got} == {0}


def test_beyond_its_range_it_says_so():
    assert readings(Mcu(lambda now: (0.6, 0.0), seed=1), 1)[0].flags == OUT_OF_RANGE
    assert readings(Mcu(lambda now: (1.2, 0.0), seed=1), 1)[0].flags == OUT_OF_RANGE | SATURATED


def test_clock_and_sequence():
    mcu = Mcu(seed=1, rate_hz=20, drift_ppm=1000)
    (identity,) = LineParser().parse(mcu.reset(5.0))
    assert identity == Identity(version=2, firmware=0x0200, unit=0x53494D00, rate_hz=20, delay_ms=24)
    samples = LineParser().parse(b"".join(mcu.sample() for _ in range(101)))
    assert samples[0].status == SampleStatus.FIRST and samples[1].status == 0
    # Its samples are due by its own clock, which is fast.
    assert samples[-1].milliseconds - samples[0].milliseconds == pytest.approx(5000, abs=1)
    assert mcu.due - 5.0 == pytest.approx(102 * 0.05 / 1.001 + 0.0352, abs=1e-3)


def test_commands_are_answered():
    mcu = Mcu(seed=1)
    parser = LineParser()
    stream = mcu_protocol.identify_command() + mcu_protocol.rate_command(25)
    assert [m.rate_hz for m in parser.parse(mcu.receive(stream[:5]) + mcu.receive(stream[5:]))] == [10, 25]
    stream = (
        mcu_protocol.frame(b"R,00")
        + mcu_protocol.frame(b"R,33")
        + mcu_protocol.frame(b"R,A")
        + b"$Q*0000\r\n"
    )
    refusals = [
        Refusal(r) for r in (Reason.OUT_OF_RANGE, Reason.OUT_OF_RANGE, Reason.UNKNOWN, Reason.CHECKSUM)
    ]
    assert parser.parse(mcu.receive(stream)) == refusals


def test_a_link_replaces_a_link_but_nothing_else(tmp_path):
    path = tmp_path / "port"
    path.symlink_to("/nowhere")
    port = Pty(str(path))
    assert os.readlink(path) == port.path
    port.close()
    assert not path.is_symlink()
    path.write_text("mine")
    with pytest.raises(FileExistsError):
        Pty(str(path))
    assert path.read_text() == "mine"


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_the_executable_ends_cleanly_and_removes_its_link(tmp_path, number):
    path = tmp_path / "port"
    process = subprocess.Popen(
        [*COMMAND, "--link", str(path)], stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    assert str(path).encode() in process.stdout.readline()
    assert path.is_symlink()
    process.send_signal(number)
    _, err = process.communicate(timeout=WAIT_S)
    assert (process.returncode, err) == (0, b"")
    assert not path.is_symlink()


def test_the_executable_refuses_with_one_line(tmp_path):
    path = tmp_path / "port"
    path.write_text("mine")
    result = subprocess.run([*COMMAND, "--link", str(path)], capture_output=True, timeout=WAIT_S, check=False)
    assert result.returncode == 1
    assert result.stderr.count(b"\n") == 1 and b"choose another --link" in result.stderr
    assert subprocess.run([*COMMAND, "--rate", "99"], capture_output=True, check=False).returncode == 2

# SPDX-License-Identifier: Apache-2.0
"""The firmware of the Arduino Nano as it is flashed, on an emulated ATmega328P with an SCL3300.

The sensor's model is written after its data sheet and reports violations of it; each test ends by asking it.
"""

import math
import re
import subprocess

import numpy as np
import pytest
from board import ELF, FIRMWARE, Board

from starpos.messages.tilt import OUT_OF_RANGE, STUCK
from starpos.parameters.table import defaults_of
from starpos_inclinometer.sources import mcu_protocol
from starpos_inclinometer.sources.mcu_protocol import Identity, Sample, SampleStatus, SensorKind
from starpos_inclinometer.sources.tilts import Scl3300
from starpos_testing.emulator import DEFAULT_RATE_HZ

BOOT_MS = 300
FLASH_BYTES, RAM_BYTES, STACK_BYTES = 32768, 2048, 256
STEP_DEG = 90 / 2**14


@pytest.fixture
def board(built):
    board = Board(built, board="nano")
    board.connect()
    yield board
    assert board.close() == ""


def samples(messages):
    return [m for m in messages if isinstance(m, Sample)]


def readings(messages):
    sensor = Scl3300(defaults_of("inclinometer"))
    return [sensor.measure(s, 0.0) for s in samples(messages)]


def angles(messages):
    """deg, (n, 2)."""
    return np.degrees([(r.x, r.y) for r in readings(messages)])


def at_rate(board, rate_hz):
    board.run(BOOT_MS)
    return next(m for m in board.messages(30, mcu_protocol.rate_command(rate_hz)) if isinstance(m, Identity))


def test_fits_the_microcontroller(built):
    size = ["avr-size", built / ELF.format("nano")]
    out = subprocess.run(size, capture_output=True, text=True, check=True).stdout
    text, data, bss = map(int, out.splitlines()[1].split()[:3])
    assert text + data <= FLASH_BYTES and data + bss <= RAM_BYTES - STACK_BYTES


def test_wiring_table_is_the_boards():
    """Arduino's D8 to D13 are port B, D0 to D7 port D."""
    readme = (FIRMWARE.parent / "README.md").read_text()
    pins = dict(
        re.findall(r"#define PIN_(SCL3300_CS|SHUTTER|PPS) (P\w\d)", (FIRMWARE / "board.h").read_text())
    )
    arduino = {name: int(pin[2]) + (8 if pin[1] == "B" else 0) for name, pin in pins.items()}
    for name, text in (("SCL3300_CS", "CSB"), ("SHUTTER", "shutter"), ("PPS", "pulse per second")):
        (row,) = re.findall(rf"^\| D{arduino[name]} .*$", readme, re.MULTILINE)
        assert text in row


def test_says_which_sensor_it_has_and_is_well_from_the_first_sample(board):
    first, *rest = board.messages(600)
    assert first == Identity(
        version=2, firmware=0x0200, unit=0, rate_hz=DEFAULT_RATE_HZ, delay_ms=61, kind=SensorKind.SCL3300
    )
    assert [s.status for s in samples(rest)] == [SampleStatus.FIRST] + [0] * (len(rest) - 1)
    assert len(rest) >= 4 and board.tell("state")["sensor_resets"] == 1


@pytest.mark.parametrize("tilt", [(0, 0), (3, -20), (-60, 25), (89.9, 0)])
def test_the_codes_are_the_sensors_angles(board, tilt):
    board.tell("noise 0")
    board.tell("tilt {} {}".format(*tilt))
    at_rate(board, 50)
    got = angles(board.messages(400))
    assert len(got) == pytest.approx(20, abs=2)
    assert np.abs(got - tilt).max() < 0.51 * STEP_DEG


def test_an_average_has_more_digits_than_the_sensor(board):
    """A rounding of 0.0055 deg under noise as large averages away: 10 Hz are 5 readings, 1 Hz 50."""
    board.tell("tilt 3.0011 -1")
    at_rate(board, 2)
    got = angles(board.messages(12_000))[:, 0]
    # the model's noise, 0.0042 deg, is within 18 Hz: neighbours 20 ms apart are alike
    assert got.mean() == pytest.approx(3.0011, abs=0.001) and got.std() < 0.0015


@pytest.mark.parametrize(("rate_hz", "within_ms"), [(1, 0.4), (7, 0.4), (50, 0.8)])
def test_the_milliseconds_are_those_of_the_reading(board, rate_hz, within_ms):
    """The tilt goes through the range at 10 deg/s: each angle shows the time it was taken at."""
    board.tell("noise 0")
    identity = at_rate(board, rate_hz)
    begin = board.tell("tilt -30 30 10 -10")["ms"]
    data = board.run(4000)
    while not data.endswith(b"\r\n"):
        data += board.run(1)
    got = samples(board.parse(data))[2:]
    times = begin + 100 * (angles(got) * [1, -1] + 30)
    assert np.abs(times.mean(1) - [s.milliseconds for s in got]).max() < within_ms
    steps = np.diff([s.milliseconds for s in got])
    assert np.abs(steps - 1000 / rate_hz).max() < 1
    assert board.tell("state")["line_ms"] - got[-1].milliseconds == pytest.approx(identity.delay_ms, abs=0.7)


@pytest.mark.parametrize("celsius", [-40, 20, 125])
def test_temperature(board, celsius):
    board.tell(f"temperature {celsius}")
    assert readings(board.messages(600))[-1].temperature_c == pytest.approx(celsius, abs=0.5)


@pytest.mark.parametrize(
    ("fault", "end", "status"),
    [
        ("miso 0", "miso 1", SampleStatus.NO_ANSWER),
        ("noisy 1", "noisy 0", SampleStatus.NO_ANSWER),
        ("selftest 1801", "selftest -1799", SampleStatus.SELF_TEST),
        ("selftest -1801", "selftest 0", SampleStatus.SELF_TEST),
    ],
)
def test_a_fault_is_flagged_while_it_lasts_and_no_wrong_angle_passes(board, fault, end, status):
    board.tell("noise 0")
    board.tell("tilt 20 -20")
    at_rate(board, 50)
    board.tell(fault)
    bad = samples(board.messages(1000))[2:]
    assert len(bad) > 40 and all(s.status & status for s in bad)
    assert all(r.flags & STUCK for r in readings(bad))
    board.tell(end)
    again = samples(board.messages(600))
    assert again[-1].status == 0
    assert np.abs(angles([s for s in bad + again if not s.status]) - [20, -20]).max() < STEP_DEG


@pytest.mark.parametrize("fault", ["fail 64", "fail 16", "supply"])
def test_an_error_of_the_sensors_own_sets_it_up_again(board, fault):
    """Saturation, its supply's supervision, a supply that was away: without its angles on it would send zeros."""
    board.tell("noise 0")
    board.tell("tilt 20 -20")
    at_rate(board, 50)
    resets = board.tell(fault)["sensor_resets"]
    got = samples(board.messages(1000))
    assert SampleStatus.MEANINGLESS in {s.status for s in got} and got[-1].status == 0
    assert np.abs(angles([s for s in got if not s.status]) - [20, -20]).max() < STEP_DEG
    assert board.tell("state")["sensor_resets"] == resets + 1


def test_without_a_sensor_it_says_so_from_the_start_and_takes_it_when_it_comes(board):
    board.tell("miso 0")
    got = samples(board.messages(1000))
    assert len(got) >= 8 and all(s.status & SampleStatus.NO_ANSWER for s in got)
    board.tell("miso 1")
    assert samples(board.messages(600))[-1].status == 0


def test_on_its_face_it_is_out_of_range(board):
    board.tell("face 1")
    got = readings(board.messages(600))
    assert all(r.flags & OUT_OF_RANGE for r in got)
    board.tell("face 0")
    assert readings(board.messages(600))[-1].flags == 0


def test_a_hung_mcu_is_reset_and_goes_on(board):
    at_rate(board, 50)
    board.messages(507)
    board.tell("hang")
    first = next(s for s in samples(board.messages(1500)) if s.status & SampleStatus.FIRST)
    assert first.status == SampleStatus.FIRST | SampleStatus.WATCHDOG and first.broken
    assert (board.parser.counts.crc_errors, board.parser.counts.malformed) == (0, 0)


def test_the_claimed_noise_is_that_of_the_readings(board):
    at_rate(board, 50)
    sensor = Scl3300(defaults_of("inclinometer"))
    got = [sensor.measure(s, 0.02 * k) for k, s in enumerate(samples(board.messages(20_000)))]
    means = np.array([(r.x, r.y) for r in got[: len(got) // 50 * 50]]).reshape(-1, 50, 2).mean(1)
    claimed = math.sqrt(got[-1].covariance[0] / 50)
    assert 0.6 < means.std(0).mean() / claimed < 1.4

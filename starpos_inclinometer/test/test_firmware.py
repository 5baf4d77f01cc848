# SPDX-License-Identifier: Apache-2.0
"""The firmware as it is flashed, on an emulated ATmega8 with an AD7730 and an SCA100T: what it says on its line.

In most tests the board's time passes only as they let it; each ends by asking whether the firmware has done
something to the two parts that their data sheets forbid.
"""

import math
import random
import re
import subprocess
from itertools import pairwise

import numpy as np
import pytest
from board import ELF, FIRMWARE, SIM, Board

from starpos.parameters.table import defaults_of
from starpos_inclinometer.sources import mcu_protocol
from starpos_inclinometer.sources.mcu_protocol import (
    Identity,
    LineParser,
    Reason,
    Refusal,
    Sample,
    SampleStatus,
)
from starpos_inclinometer.sources.tilts import Sca100t
from starpos_testing.emulator import DEFAULT_RATE_HZ, Mcu

VALUES = defaults_of("inclinometer")

# Reset, calibration and a first sample.
BOOT_MS = 1000
# Noise of one sample at 50 Hz, the sensor itself being still.
ADC_NOISE_RAD = math.radians(0.0006)
FLASH_BYTES, RAM_BYTES, STACK_BYTES = 8192, 1024, 256


@pytest.fixture
def start(built):
    boards = []

    def start(*options, **more):
        boards.append(Board(built, *options, **more))
        return boards[-1]

    yield start
    assert [board.close() for board in boards] == [""] * len(boards)


@pytest.fixture
def board(start):
    """A board whose host listens from the power-up on."""
    board = start()
    board.connect()
    return board


def samples(messages):
    return [m for m in messages if isinstance(m, Sample)]


def angles(messages):
    """deg, (n, 2)."""
    sensor = Sca100t(VALUES)
    return np.degrees([(r.x, r.y) for r in (sensor.measure(s, 0.0) for s in samples(messages))])


def at_rate(board, rate_hz):
    """Boot, ask for a rate; what the first samples at it say is the caller's."""
    board.run(BOOT_MS)
    return next(m for m in board.messages(30, mcu_protocol.rate_command(rate_hz)) if isinstance(m, Identity))


def test_fits_the_microcontroller(built):
    out = subprocess.run(
        ["avr-size", built / ELF.format("paper")], capture_output=True, text=True, check=True
    ).stdout
    text, data, bss = map(int, out.splitlines()[1].split()[:3])
    assert text + data <= FLASH_BYTES and data + bss <= RAM_BYTES - STACK_BYTES


def test_wiring_table_and_divider_are_the_boards():
    header = (FIRMWARE / "board.h").read_text()
    table = [
        line for line in (FIRMWARE.parent / "README.md").read_text().splitlines() if line.startswith("| P")
    ]
    pins = re.findall(r"#define PIN_(AD7730|SCA100T)_(\w+) (P\w\d)", header)
    assert len(pins) == 3
    for chip, signal, pin in pins:
        (row,) = (line.split("|") for line in table if line.startswith(f"| {pin} "))
        assert signal in row[3 if chip == "AD7730" else 4]
    r1, r2 = (int(re.search(rf"#define DIVIDER_R{i}_OHM (\d+)UL", header)[1]) for i in (1, 2))
    assert (r1 + r2) / r2 == VALUES["divider"]


def test_says_who_it_is_before_the_first_sample(start):
    board = start("--unit", "53494D00")
    board.connect()
    first, *rest = board.messages(BOOT_MS)
    assert first == Identity(
        version=2, firmware=0x0200, unit=0x53494D00, rate_hz=DEFAULT_RATE_HZ, delay_ms=54
    )
    assert [s.status for s in samples(rest)] == [SampleStatus.FIRST] + [0] * (len(rest) - 1)
    assert [s.sequence for s in samples(rest)] == list(range(len(rest)))
    assert board.messages(50, mcu_protocol.identify_command()).count(first) == 1


def test_a_unit_without_serial_number_says_0(board):
    assert board.messages(BOOT_MS)[0].unit == 0


@pytest.mark.parametrize("rate_hz", [1, 2, 3, 7, 10, 16, 17, 30, 33, 49, 50])
def test_takes_the_samples_of_its_rate(board, rate_hz):
    # Fractions of milliseconds are its business alone.
    at_rate(board, 49)
    identity = at_rate(board, rate_hz)
    assert identity.rate_hz == rate_hz
    seconds = 6
    data = board.run(1000 * seconds)
    while not data.endswith(b"\r\n"):
        data += board.run(1)
    got = samples(board.parse(data))
    assert len(got) == pytest.approx(rate_hz * seconds, abs=2)
    steps = np.diff([s.milliseconds for s in got])
    assert np.abs(steps - 1000 / rate_hz).max() < 1
    assert steps.sum() == pytest.approx(1000 / rate_hz * len(steps), abs=1)
    assert [s.status for s in got[1:]] == [0] * (len(got) - 1) and board.parser.counts.lost == 0
    assert len(data) <= mcu_protocol.SAMPLE_LINE * (rate_hz * seconds + 1)
    sent_ms = board.tell("state")["line_ms"]
    assert sent_ms - got[-1].milliseconds == pytest.approx(identity.delay_ms, abs=0.3)


def test_the_rate_it_has_already_disturbs_no_sample(board):
    at_rate(board, 5)
    got = []
    for _ in range(40):
        got += samples(board.messages(50, mcu_protocol.rate_command(5)))
    assert len(got) == pytest.approx(10, abs=1) and {s.status for s in got[1:]} == {0}
    assert {b.milliseconds - a.milliseconds for a, b in pairwise(got)} == {200}


@pytest.mark.parametrize("tilt", [(0, 0), (3, -20), (-29.9, 29.9), (12.3, 0.01), (30, -30)])
def test_the_codes_are_the_sensors_equation(board, tilt):
    board.tell("noise 0")
    board.tell("tilt {} {}".format(*tilt))
    at_rate(board, 50)
    got = angles(board.messages(1000))
    assert len(got) == pytest.approx(50, abs=2)
    tolerance = np.degrees(ADC_NOISE_RAD) / np.cos(np.radians(tilt))
    assert (np.abs(got.mean(0) - tilt) < 4 * tolerance / math.sqrt(50)).all()
    assert (np.abs(got - tilt) < 5 * tolerance).all()


def test_slower_samples_are_averages(board):
    """The sensor's 0.0042 deg within its 18 Hz become what the README says of the rates."""
    noise = {}
    for rate_hz in (50, 10, 2):
        at_rate(board, rate_hz)
        noise[rate_hz] = angles(board.messages(400_000 // rate_hz)).std(0).mean()
    assert noise == pytest.approx({50: 0.0036, 10: 0.0018, 2: 0.00085}, rel=0.12)


@pytest.mark.parametrize("rate_hz", [50, 10])
def test_the_milliseconds_are_the_middle_of_both_axes(board, rate_hz):
    """The tilt goes through the range at 10 deg/s: each angle shows the time it was taken at."""
    board.tell("noise 0")
    at_rate(board, rate_hz)
    begin = board.tell("tilt -10 10 10 -10")["ms"]
    got = samples(board.messages(1500))[2:]
    times = begin + 100 * (angles(got) * [1, -1] + 10)
    apart = times[:, 0] - times[:, 1]
    # The noise of one is 0.085.
    assert abs(apart.mean()) < 0.05 and np.abs(apart).max() < 0.5
    assert np.abs(times.mean(1) - [s.milliseconds for s in got]).max() < 0.7


@pytest.mark.parametrize("celsius", [-40, -10, 20, 85, 125])
def test_temperature(board, celsius):
    board.tell(f"temperature {celsius}")
    sample = samples(board.messages(BOOT_MS))[-1]
    assert sample.status == 0
    assert Sca100t(VALUES).measure(sample, 0.0).temperature_c == pytest.approx(celsius, abs=0.47)


def test_without_the_sensors_answer_it_says_so_and_sends_on(board):
    board.tell("sensor 0")
    assert {s.status for s in samples(board.messages(2000))[1:]} == {SampleStatus.NO_TEMPERATURE}
    board.tell("sensor 1")
    assert samples(board.messages(1000))[-1].status == 0


@pytest.mark.parametrize("rate_hz", [50, 10])
def test_a_stuck_converter_is_flagged_reset_and_calibrated_again(board, rate_hz):
    board.tell("noise 0")
    board.tell("tilt 5 -5")
    at_rate(board, rate_hz)
    before = samples(board.messages(500))[-1]
    resets = board.tell("freeze 1")["adc_resets"]
    stuck = samples(board.messages(2000))[2:]
    assert len(stuck) == pytest.approx(2 * rate_hz - 2, abs=2)
    assert {s.status for s in stuck} == {SampleStatus.NO_ANSWER}
    assert {(s.x, s.y) for s in stuck[1:]} == {(stuck[0].x, stuck[0].y)}
    assert abs(stuck[0].x - before.x) < 1000
    assert board.tell("freeze 0")["adc_resets"] > resets
    again = samples(board.messages(2000))
    assert again[-1].status == 0 and board.tell("state")["calibrated"]
    good = [s for s in again if not s.status]
    # Before the calibration it is 0.1 deg off.
    assert np.abs(angles(good) - [5, -5]).max() < 0.004


def test_a_converter_that_a_spike_has_reset_never_sends_an_uncalibrated_code_unflagged(board):
    board.tell("noise 0")
    board.tell("tilt 20 -20")
    at_rate(board, 50)
    assert not board.tell("adc")["calibrated"]
    got = samples(board.messages(2000))
    assert SampleStatus.NO_ANSWER in {s.status for s in got} and got[-1].status == 0
    assert np.abs(angles([s for s in got if not s.status]) - [20, -20]).max() < 0.005


def test_an_interface_out_of_step_is_noticed_before_a_wrong_code_is_sent(board):
    board.tell("noise 0")
    board.tell("tilt 20 -20")
    at_rate(board, 50)
    got = []
    # Bytes: a burst has less.
    for after in range(1, 50):
        got += board.messages(500)
        assert samples(got)[-1].status == 0
        board.tell(f"slip {after}")
    got = samples(got + board.messages(500))
    assert got[-1].status == 0 and sum(s.status != 0 for s in got) > 200
    assert np.abs(angles([s for s in got if not s.status]) - [20, -20]).max() < 0.005


@pytest.mark.parametrize("from_power_up", [True, False])
def test_without_reference_it_says_so_and_calibrates_when_it_is_back(board, from_power_up):
    board.tell("noise 0")
    board.tell("tilt 20 -20")
    if not from_power_up:
        at_rate(board, 50)
    board.tell("reference 0")
    without = samples(board.messages(2000))[2:]
    assert {s.status for s in without} == {SampleStatus.MEANINGLESS}
    assert {(s.x, s.y) for s in without} == {(0xFFFFFF, 0xFFFFFF)}
    board.tell("reference 1")
    got = samples(board.messages(3000))
    assert got[-1].status == 0 and board.tell("state")["calibrated"]
    assert np.abs(angles([s for s in got if not s.status]) - [20, -20]).max() < 0.005


@pytest.mark.parametrize(
    ("cause", "status"),
    [
        ("hang", SampleStatus.FIRST | SampleStatus.WATCHDOG),
        ("reset", SampleStatus.FIRST),
        ("power", SampleStatus.FIRST),
    ],
)
def test_a_reset_in_the_middle_tells_its_cause(board, cause, status):
    at_rate(board, 50)
    # It is 7 ms into a line.
    board.messages(507)
    board.tell(cause)
    messages = board.messages(2000)
    identity, first, *rest = messages[next(i for i, m in enumerate(messages) if isinstance(m, Identity)) :]
    assert identity.rate_hz == DEFAULT_RATE_HZ
    assert first.status == status and first.broken
    assert {s.status for s in rest} == {0} and len(rest) >= 10
    assert first.milliseconds < 400
    counts = board.parser.counts
    assert (counts.restarts, counts.crc_errors, counts.malformed) == (1, 0, 0)


@pytest.mark.parametrize("left", [2, 1])
def test_a_write_to_the_converter_that_a_reset_cut_short_leaves_no_trace(board, left):
    board.tell("noise 0")
    board.tell("tilt 20 -20")
    at_rate(board, 50)
    board.tell(f"hang {left}")
    got = samples(board.messages(3000))
    assert sum(s.status & SampleStatus.WATCHDOG != 0 for s in got) == 1 and got[-1].status == 0
    assert np.abs(angles([s for s in got if not s.status]) - [20, -20]).max() < 0.005


def test_the_cause_of_a_reset_is_not_that_of_the_next(board):
    for cause, status in (
        ("hang", SampleStatus.FIRST | SampleStatus.WATCHDOG),
        ("reset", SampleStatus.FIRST),
    ):
        board.run(BOOT_MS)
        board.tell(cause)
        (first,) = (s for s in samples(board.messages(BOOT_MS)) if s.status & SampleStatus.FIRST)
        assert first.status == status


COMMANDS = [
    mcu_protocol.identify_command(),
    mcu_protocol.rate_command(50),
    mcu_protocol.frame(b"R,00"),
    mcu_protocol.frame(b"R,33"),
    mcu_protocol.frame(b"R,FF"),
    mcu_protocol.frame(b"R,0a"),
    mcu_protocol.frame(b"R,0"),
    mcu_protocol.frame(b"R,00A"),
    mcu_protocol.frame(b"R0A"),
    mcu_protocol.frame(b"q"),
    mcu_protocol.frame(b"QQ"),
    mcu_protocol.frame(b"Q,"),
    mcu_protocol.frame(b" Q"),
    mcu_protocol.frame(b"T,0000"),
    b"$Q*0000\r\n",
    b"$R,32*0000\r\n",
    mcu_protocol.frame(b"Q").lower(),
    mcu_protocol.frame(b"Q").replace(b"\r", b""),
    mcu_protocol.frame(b"Q").replace(b"\n", b""),
    mcu_protocol.frame(b"Q").replace(b"$", b""),
    mcu_protocol.frame(b"Q").replace(b"*", b""),
    mcu_protocol.frame(b"Q*1234"),
    b"$*0000\r\n",
    b"$\r\n",
    b"\r\n",
    b"$$" + mcu_protocol.frame(b"Q"),
    b"$R,1" + mcu_protocol.frame(b"Q"),
    bytes(range(256)) + mcu_protocol.frame(b"Q"),
]


@pytest.mark.parametrize("command", COMMANDS, ids=lambda c: repr(c[-20:]))
def test_answers_as_the_protocol_says(board, command):
    """The Python emulation reads the same bytes; only the delay is the board's own."""
    said = LineParser().parse(Mcu().receive(command))
    board.run(BOOT_MS)
    got = [m for m in board.messages(200, command + b"\r\n") if not isinstance(m, Sample)]

    def plain(messages):
        return [(m.version, m.rate_hz) if isinstance(m, Identity) else m for m in messages]

    assert plain(got) == plain(said)
    assert any(isinstance(m, Identity) for m in board.messages(100, mcu_protocol.identify_command()))
    assert board.parser.counts.crc_errors == board.parser.counts.malformed == 0


def test_a_line_that_is_too_long_is_dropped_silently(board):
    board.run(BOOT_MS)
    longest = mcu_protocol.frame(b"QQQQQQQQ")
    assert len(longest) == 16
    assert Refusal(Reason.UNKNOWN) in board.messages(100, longest)
    for body in (b"QQQQQQQQQ", b"Q" * 40, b"Q" * 200):
        assert all(isinstance(m, Sample) for m in board.messages(200, mcu_protocol.frame(body)))
    assert any(isinstance(m, Identity) for m in board.messages(100, mcu_protocol.identify_command()))


def test_noise_on_the_line_does_not_stop_it(board):
    board.run(BOOT_MS)
    rng = random.Random(1)
    for _ in range(20):
        noise = bytes(rng.choice(b"$$$QR,*0123456789ABCDEF\r\n\r\n\x00\xff") for _ in range(120))
        board.messages(100, noise)
    assert any(
        isinstance(m, Identity) for m in board.messages(200, b"\r\n" + mcu_protocol.identify_command())
    )
    counts = board.parser.counts
    assert (counts.crc_errors, counts.malformed, counts.lost, counts.restarts) == (0, 0, 0, 0)


def test_a_flood_of_commands_costs_whole_samples_and_says_so(board):
    at_rate(board, 50)
    board.messages(500)
    got = []
    for _ in range(10):
        got += board.messages(100, mcu_protocol.identify_command() * 25)
    got += board.messages(500)
    counts = board.parser.counts
    assert (counts.crc_errors, counts.malformed, counts.restarts) == (0, 0, 0)
    assert counts.lost > 0
    for sample in samples(got):
        assert bool(sample.status & SampleStatus.OVERRUN) == (sample.lost > 0)
    assert [s.status for s in samples(got)[-10:]] == [0] * 10


def test_what_is_no_firmware_is_refused(built):
    command = [built / SIM, __file__]
    result = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, text=True, check=False)
    assert result.returncode == 1 and result.stderr.strip().endswith("not a firmware for this board")
    assert result.stdout == ""


def test_registers_are_the_data_sheets(board):
    """Mode: continuous or idle, bipolar, 24 bits, 5 V reference, +-80 mV; filter: SF 150, FASTStep, chopping."""
    board.run(BOOT_MS)
    state = board.tell("state")
    assert state["mode"] & 0x1FFE == 0x01B0
    assert (state["filter"], state["dac"]) == (150 << 12 | 0x110, 0x20)
    assert state["calibrated"]

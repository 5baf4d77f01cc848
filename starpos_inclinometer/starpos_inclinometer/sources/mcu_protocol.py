# SPDX-License-Identifier: Apache-2.0
"""The protocol of the board's serial line, as PROTOCOL.md defines it, and the check that its samples fit one another.

A 16-bit checksum lets one corrupted line in 65,536 pass, and a line without a checksum passes far more often. Such a
sample does not fit the samples around it: its number, its time or its tilt is wrong. No I/O, no clock.
"""

import re
from binascii import crc_hqx
from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import IntEnum, IntFlag

from starpos_inclinometer.sources.source import Arrival, Counts

VERSION = 2
BAUD = 38400
MIN_RATE_HZ, MAX_RATE_HZ = 1, 50
# Bytes with '$' and CR LF, in both directions.
MAX_LINE = 48
# Bytes of a `$T` line.
SAMPLE_LINE = 43
# Bit of the K field of a `$P` line.
RISING = 0x80
# A line is sent within the period of its sample and this time.
MAX_SENDING_MS = 50

_LINE = re.compile(rb"\$([^$*\r\n]{1,40})\*([0-9A-F]{4})\r\n")


class SampleStatus(IntFlag):
    """Status bits of a sample; unknown bits belong to later versions and are ignored."""

    # The sensor, or its converter, did not answer in time, or with a wrong checksum: the codes are those before.
    NO_ANSWER = 0x01
    # The AD7730's NOREF bit, or an error that the SCL3300 reports: the codes mean nothing.
    MEANINGLESS = 0x02
    NO_TEMPERATURE = 0x04
    # The first sample since the reset.
    FIRST = 0x08
    # The watchdog made that reset.
    WATCHDOG = 0x10
    # At least one sample before this one was not sent.
    OVERRUN = 0x20
    # The SCL3300's Z axis points below the horizon.
    UPSIDE_DOWN = 0x40
    # The SCL3300's self-test failed.
    SELF_TEST = 0x80


class SensorKind(IntEnum):
    """The sensor of a unit."""

    # SCA100T-D01 behind an AD7730.
    SCA100T = 0
    # SCL3300-D01.
    SCL3300 = 1


class Input(IntEnum):
    """What a pulse came from."""

    SHUTTER = 0
    PPS = 1


class Reason(IntEnum):
    """Why a command was refused."""

    CHECKSUM = 1
    UNKNOWN = 2
    OUT_OF_RANGE = 3


@dataclass(frozen=True, slots=True, kw_only=True)
class Sample:
    """One `$T` line, and what `Continuity` adds from the lines before it."""

    # 16 bits as sent. `Continuity` continues it over wraps and resets: a jump of n + 1 means n lost samples.
    sequence: int
    # The MCU's clock at the middle of the conversions, 32 bits.
    milliseconds: int
    # Codes, 24-bit offset binary: 0x800000 is no input of the AD7730, or an angle of 0 of the SCL3300.
    x: int
    y: int
    # Temperature counts of the sensor, 8 bits.
    temperature: int
    # Bits of SampleStatus.
    status: int
    # Samples lost just before this one.
    lost: int = 0
    # It does not continue the one before: the MCU was reset, or the connection was opened again.
    broken: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class Identity:
    """The MCU's answer to both commands."""

    # Version of the protocol.
    version: int
    # 0x0102 is 1.2.
    firmware: int
    # Serial number, 0 for none.
    unit: int
    rate_hz: int
    # The time from a sample to the first byte of its line.
    delay_ms: int
    kind: int = SensorKind.SCA100T


@dataclass(frozen=True, slots=True, kw_only=True)
class Pulse:
    """One `$P` line: an edge of an input."""

    # One of Input.
    input: int
    rising: bool
    # 8 bits; a jump shows how many were lost.
    number: int
    # Edges of this input since the one before, within 2 ms of one another: they have no line.
    bounces: int
    # The MCU's clock at the edge, 32 bits and 0 to 999.
    milliseconds: int
    microseconds: int


@dataclass(frozen=True, slots=True)
class Refusal:
    # One of Reason.
    reason: int


Message = Sample | Identity | Refusal | Pulse


def checksum(body: bytes) -> int:
    """Compute the CRC-16/XMODEM (polynomial 0x1021, start 0) of the bytes between '$' and '*'."""
    return crc_hqx(body, 0)


def frame(body: bytes) -> bytes:
    """Make the line of a body: `$body*CRC` CR LF."""
    return b"$%s*%04X\r\n" % (body, checksum(body))


def identify_command() -> bytes:
    return frame(b"Q")


def rate_command(rate_hz: int) -> bytes:
    """Ask for rate_hz samples a second, MIN_RATE_HZ to MAX_RATE_HZ."""
    return frame(b"R,%02X" % rate_hz)


class LineParser:
    """Parses and counts the MCU's messages from chunks of bytes; keeps at most one line; never raises, whatever comes."""

    def __init__(self) -> None:
        self.counts = Counts()
        self._rest = b""

    def parse(self, data: bytes) -> list[Message]:
        """Return the messages that `data` completes, in order; none with a wrong checksum or an impossible field."""
        messages: list[Message] = []
        buffer = self._rest + data
        end = 0
        for match in _LINE.finditer(buffer):
            self.counts.garbage_bytes += match.start() - end
            end = match.end()
            if checksum(match[1]) != int(match[2], 16):
                self.counts.crc_errors += 1
            elif (message := _parse(match[1])) is None:
                self.counts.malformed += 1
            else:
                self.counts.good += 1
                messages.append(message)
        # A '$' can only be the first byte of a line, so bytes before the last '$' cannot become a line any more.
        start = buffer.rfind(b"$", end)
        if start < 0 or len(buffer) - start >= MAX_LINE:
            start = len(buffer)
        self.counts.garbage_bytes += start - end
        self._rest = buffer[start:]
        return messages

    def forget(self) -> None:
        """Drop a half-received line, because the next bytes come from another connection."""
        self.counts.garbage_bytes += len(self._rest)
        self._rest = b""


def _form(letter: str, **digits: int) -> re.Pattern[bytes]:
    """The form of a body: a letter, and the named fields of a number of hexadecimal digits each."""
    fields = "".join(rf",(?P<{name}>[0-9A-F]{{{count}}})" for name, count in digits.items())
    return re.compile((letter + fields).encode())


def _pulse(edge: int, **fields: int) -> Pulse:
    return Pulse(input=edge & ~RISING, rising=bool(edge & RISING), **fields)


_IDENTITY = {"version": 2, "firmware": 4, "unit": 8, "rate_hz": 2, "delay_ms": 4}
_FORMS: tuple[tuple[re.Pattern[bytes], Callable[..., Message]], ...] = (
    (_form("T", sequence=4, milliseconds=8, x=6, y=6, temperature=2, status=2), Sample),
    (_form("P", edge=2, number=2, bounces=2, milliseconds=8, microseconds=4), _pulse),
    (_form("I", **_IDENTITY, kind=2), Identity),
    # Version 1 had no kind: its firmware was for the SCA100T alone.
    (_form("I", **_IDENTITY), Identity),
    (_form("N", reason=2), Refusal),
)


def _parse(body: bytes) -> Message | None:
    for form, make in _FORMS:
        if match := form.fullmatch(body):
            message = make(**{name: int(digits, 16) for name, digits in match.groupdict().items()})
            return message if _possible(message) else None
    return None


def _possible(message: Message) -> bool:
    if isinstance(message, Sample):
        return not (message.status & SampleStatus.FIRST and message.sequence)
    if isinstance(message, Pulse):
        return message.input in list(Input) and message.microseconds < 1000
    if isinstance(message, Identity):
        rate = message.rate_hz
        kind_known, rate_known = message.kind in list(SensorKind), MIN_RATE_HZ <= rate <= MAX_RATE_HZ
        return kind_known and rate_known and message.delay_ms <= 1000 / rate + MAX_SENDING_MS
    return True


# Multiple of the usual change from sample to sample that still counts as near.
TOLERANCE_OF_CHANGE = 8.0
# Weight of a new sample in the usual change.
CHANGE_SHARE = 1 / 8
# Number of samples in a row that are used even if no two are near each other: the instrument moves.
WITNESSES = 3

# Both ends of a period are rounded down to ms.
PERIOD_TOLERANCE_MS = 2
# Periods of the highest and the lowest rate.
SHORTEST_MS, LONGEST_MS = 20, 1000
# Counts; 2.8 deg C from one sample to the next.
TEMPERATURE_TOLERANCE = 3
FAULTS = SampleStatus.NO_ANSWER | SampleStatus.MEANINGLESS
# The host may stall for a time; the MCU's RC oscillator may be wrong by a share.
HOST_TOLERANCE_S, HOST_TOLERANCE_SHARE = 3.0, 0.05


class Gate:
    """Lets samples pass that fit the last one; others wait until later samples confirm them, or are dropped.

    follows: whether the second arrival may come after the first, judged by everything except `x` and `y`.
    tolerance: change of `x` and `y` between two samples that is always accepted; changes like the recent ones are
    accepted too.
    """

    def __init__(self, follows: Callable[[Arrival, Arrival], bool], tolerance: float, counts: Counts) -> None:
        self._follows, self._counts = follows, counts
        self.tolerance = tolerance
        self._change = 0.0
        self._last: Arrival | None = None
        self._waiting: list[Arrival] = []

    def reset(self) -> None:
        """Forget the samples so far, because the connection was opened again."""
        self._last = None
        self._waiting = []

    def admit(self, arrival: Arrival) -> list[Arrival]:
        """Take an arrival; return those that are believed now, in order."""
        last, waiting = self._last, self._waiting
        newest = waiting[-1] if waiting else last
        if newest is not None and newest.sample == arrival.sample:
            self._counts.duplicates += 1
            return []
        if last is not None and self._follows(last, arrival) and self._near(last, arrival):
            self._counts.implausible += len(waiting)
            return self._believe([arrival])
        if waiting and self._follows(waiting[-1], arrival):
            settled = self._near(waiting[-1], arrival)
            waiting.append(arrival)
            return self._believe(waiting) if settled or len(waiting) == WITNESSES else []
        self._counts.implausible += len(waiting)
        self._waiting = [arrival]
        return []

    def _near(self, a: Arrival, b: Arrival) -> bool:
        return _change(a, b) <= max(self.tolerance, TOLERANCE_OF_CHANGE * self._change)

    def _believe(self, arrivals: list[Arrival]) -> list[Arrival]:
        for arrival in arrivals:
            if self._last is not None:
                # A single leap must not make leaps usual, so its size is limited.
                limit = 4 * max(self.tolerance, TOLERANCE_OF_CHANGE * self._change)
                self._change += CHANGE_SHARE * (min(_change(self._last, arrival), limit) - self._change)
            self._last = arrival
        self._waiting = []
        return arrivals


def _change(a: Arrival, b: Arrival) -> float:
    return max(abs(b.sample.x - a.sample.x), abs(b.sample.y - a.sample.y))


def clocks_agree(elapsed_ms: int, a: Arrival, b: Arrival) -> bool:
    """Whether the device's clock went on between two arrivals about as the host's did."""
    apart_s = b.moment.monotonic_s - a.moment.monotonic_s
    return abs(elapsed_ms * 1e-3 - apart_s) <= HOST_TOLERANCE_S + HOST_TOLERANCE_SHARE * apart_s


def mcu_follows(a: Arrival, b: Arrival, period_ms: float | None) -> bool:
    """Whether one sample may follow another in the same run of the MCU (period None: its rate is not known).

    Judged by number, the MCU's time, the host's time, temperature and status.
    """
    ahead = (b.sample.sequence - a.sample.sequence) & 0xFFFF
    elapsed = (b.sample.milliseconds - a.sample.milliseconds) & 0xFFFFFFFF
    if not ahead or b.sample.status & SampleStatus.FIRST:
        return False
    # The end of a fault must be confirmed by a second sample.
    if _temperature_leaps(a.sample, b.sample) or a.sample.status & FAULTS & ~b.sample.status:
        return False
    low, high = (SHORTEST_MS, LONGEST_MS) if period_ms is None else (period_ms, period_ms)
    if not low * ahead - PERIOD_TOLERANCE_MS <= elapsed <= high * ahead + PERIOD_TOLERANCE_MS:
        return False
    return clocks_agree(elapsed, a, b)


def _temperature_leaps(a: Sample, b: Sample) -> bool:
    known = not (a.status | b.status) & SampleStatus.NO_TEMPERATURE
    return known and abs(b.temperature - a.temperature) > TEMPERATURE_TOLERANCE


class Continuity:
    """Continues the sequence numbers over wraps and resets of the MCU, and counts the lost samples."""

    def __init__(self, counts: Counts) -> None:
        self._counts = counts
        self._last: Sample | None = None
        self._last_raw_sequence = 0
        self._resumed = False

    def resume(self) -> None:
        """Note that the connection was opened again: the next sample does not continue the last one."""
        self._resumed = self._last is not None

    def follow(self, sample: Sample) -> Sample:
        """Return the sample with its continued sequence, and `lost` and `broken` filled in."""
        last, broken, step = self._last, self._resumed, 1
        if last is not None:
            elapsed = (sample.milliseconds - last.milliseconds) & 0xFFFFFFFF
            ahead = (sample.sequence - self._last_raw_sequence) & 0xFFFF
            # A serial line keeps the order: a clock that goes back, or a first sample, means a reset.
            if sample.status & SampleStatus.FIRST or elapsed >= 1 << 31:
                self._counts.restarts += 1
                broken = True
            else:
                step = ahead or (1 if broken else 1 << 16)
        self._counts.lost += step - 1
        sequence = sample.sequence if last is None else (last.sequence + step) & 0xFFFFFFFF
        self._last_raw_sequence, self._resumed = sample.sequence, False
        self._last = replace(sample, sequence=sequence, lost=step - 1, broken=broken)
        return self._last

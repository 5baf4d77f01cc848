# SPDX-License-Identifier: Apache-2.0
"""The protocol of the serial line, as PROTOCOL.md defines it: framing, parsing, counting. No I/O, no clock."""

import re
from binascii import crc_hqx
from dataclasses import dataclass
from enum import IntEnum, IntFlag

VERSION = 1
BAUD = 38400
MIN_RATE_HZ, MAX_RATE_HZ = 1, 50
# Bytes with '$' and CR LF, in both directions.
MAX_LINE = 48
# Bytes of a `$T` line.
SAMPLE_LINE = 43
# A line is sent within the period of its sample and this time.
MAX_SENDING_MS = 50

_LINE = re.compile(rb"\$([^$*\r\n]{1,40})\*([0-9A-F]{4})\r\n")
_SAMPLE = re.compile(
    rb"T,([0-9A-F]{4}),([0-9A-F]{8}),([0-9A-F]{6}),([0-9A-F]{6}),([0-9A-F]{2}),([0-9A-F]{2})"
)
_IDENTITY = re.compile(rb"I,([0-9A-F]{2}),([0-9A-F]{4}),([0-9A-F]{8}),([0-9A-F]{2}),([0-9A-F]{4})")
_REFUSAL = re.compile(rb"N,([0-9A-F]{2})")
_RATE = re.compile(rb"R,([0-9A-F]{2})")


class SampleStatus(IntFlag):
    """Status bits of a sample; unknown bits belong to later versions and are ignored."""

    # A channel did not convert in time: its code is that of the sample before.
    ADC_TIMEOUT = 0x01
    # The AD7730's NOREF bit: the codes mean nothing.
    NO_REFERENCE = 0x02
    NO_TEMPERATURE = 0x04
    # The first sample since the reset.
    FIRST = 0x08
    # The watchdog made that reset.
    WATCHDOG = 0x10
    # At least one sample before this one was not sent.
    OVERRUN = 0x20


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
    # AD7730 codes, 24-bit offset binary: 0x800000 is no input.
    x: int
    y: int
    # The SCA100T's temperature counts, 8 bits.
    temperature: int
    # Bits of SampleStatus.
    status: int
    # Samples lost just before this one.
    lost: int = 0
    # The MCU was reset since the sample before.
    restarted: bool = False
    # The first sample after the connection was opened again.
    resumed: bool = False


@dataclass(frozen=True, slots=True)
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


@dataclass(frozen=True, slots=True)
class Refusal:
    # One of Reason.
    reason: int


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


def sample_line(sequence: int, milliseconds: int, x: int, y: int, temperature: int, status: int) -> bytes:
    """Make a `$T` line; sequence and milliseconds wrap at 16 and 32 bits."""
    numbers = (sequence & 0xFFFF, milliseconds & 0xFFFFFFFF, x, y, temperature, status)
    return frame(b"T,%04X,%08X,%06X,%06X,%02X,%02X" % numbers)


def identity_line(identity: Identity) -> bytes:
    i = identity
    return frame(b"I,%02X,%04X,%08X,%02X,%04X" % (i.version, i.firmware, i.unit, i.rate_hz, i.delay_ms))


def refusal_line(reason: Reason) -> bytes:
    return frame(b"N,%02X" % reason)


class LineSplitter:
    """Collects framed lines from chunks of bytes; keeps at most one line; never raises, whatever comes."""

    def __init__(self) -> None:
        self.garbage_bytes = 0
        self._rest = b""

    def feed(self, data: bytes) -> list[tuple[bytes, bool]]:
        """Return the bodies of the lines that end in `data`, each with whether its checksum is right."""
        buffer = self._rest + data
        lines = []
        end = 0
        for match in _LINE.finditer(buffer):
            self.garbage_bytes += match.start() - end
            end = match.end()
            lines.append((match[1], checksum(match[1]) == int(match[2], 16)))
        # A '$' can only be the first byte of a line, so bytes before the last '$' cannot become a line any more.
        start = buffer.rfind(b"$", end)
        if start < 0 or len(buffer) - start >= MAX_LINE:
            start = len(buffer)
        self.garbage_bytes += start - end
        self._rest = buffer[start:]
        return lines

    def forget(self) -> None:
        """Drop a half-received line, because the next bytes come from another connection."""
        self.garbage_bytes += len(self._rest)
        self._rest = b""


class LineParser:
    """Parses and counts the MCU's messages from chunks of bytes."""

    def __init__(self) -> None:
        self.good = self.crc_errors = self.malformed = 0
        self._splitter = LineSplitter()

    @property
    def garbage_bytes(self) -> int:
        return self._splitter.garbage_bytes

    def feed(self, data: bytes) -> list[Sample | Identity | Refusal]:
        """Return the messages that `data` completes, in order; none with a wrong checksum or an impossible field."""
        messages: list[Sample | Identity | Refusal] = []
        for body, right in self._splitter.feed(data):
            if not right:
                self.crc_errors += 1
            elif (message := _parse(body)) is None:
                self.malformed += 1
            else:
                self.good += 1
                messages.append(message)
        return messages

    def forget(self) -> None:
        """Drop a half-received line, because the next bytes come from another connection."""
        self._splitter.forget()


def _parse(body: bytes) -> Sample | Identity | Refusal | None:
    if match := _SAMPLE.fullmatch(body):
        sequence, milliseconds, x, y, temperature, status = (int(group, 16) for group in match.groups())
        sample = Sample(
            sequence=sequence, milliseconds=milliseconds, x=x, y=y, temperature=temperature, status=status
        )
        return None if sample.status & SampleStatus.FIRST and sample.sequence else sample
    if match := _IDENTITY.fullmatch(body):
        identity = Identity(*(int(group, 16) for group in match.groups()))
        return identity if _possible(identity) else None
    if match := _REFUSAL.fullmatch(body):
        return Refusal(int(match[1], 16))
    return None


def _possible(identity: Identity) -> bool:
    rate = identity.rate_hz
    return MIN_RATE_HZ <= rate <= MAX_RATE_HZ and identity.delay_ms <= 1000 / rate + MAX_SENDING_MS


def parse_command(body: bytes) -> tuple[str, int] | Reason:
    """Read a command as the MCU does: ('Q', 0), ('R', rate in Hz), or the reason of its refusal."""
    if body == b"Q":
        return "Q", 0
    if match := _RATE.fullmatch(body):
        rate = int(match[1], 16)
        return ("R", rate) if MIN_RATE_HZ <= rate <= MAX_RATE_HZ else Reason.OUT_OF_RANGE
    return Reason.UNKNOWN

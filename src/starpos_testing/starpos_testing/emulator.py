# SPDX-License-Identifier: Apache-2.0
"""An emulated inclinometer: the microcontroller's side of PROTOCOL.md, byte for byte, on a pseudo-terminal.

`Mcu` is the device without I/O; the caller gives it the time. `Pty` is the cable. `Emulator` runs an `Mcu` on a `Pty`
in real time. Nothing here is the driver's: protocol, converter and sensor are written down a second time, as a check.
"""

import argparse
import contextlib
import errno
import math
import os
import random
import re
import select
import sys
import time
import tty
from binascii import crc_hqx
from collections.abc import Callable
from dataclasses import dataclass, field, fields
from typing import Any

BAUD, MAX_RATE_HZ = 38400, 50
PROTOCOL_VERSION, FIRMWARE, UNIT = 2, 0x0200, 0x53494D00
# Bit of the K field of a `$P` line, the status of the first sample, the reasons of a refusal.
RISING, FIRST = 0x80, 0x08
CHECKSUM, UNKNOWN, OUT_OF_RANGE = 1, 2, 3
COMMAND = re.compile(rb"\$([^$*\r\n]{1,40})\*([0-9A-F]{4})\r\n")
# The AD7730's codes: offset binary, 80 mV at a reference of 5 V; the divider of 30 and 1 kohm before it.
CODE_ZERO, CODE_MAX, ADC_RANGE_V, REFERENCE_V, DIVIDER = 1 << 23, (1 << 24) - 1, 0.080, 5.0, 31.0
# The SCA100T-D01's output, and its temperature counts.
OFFSET_V, SENSITIVITY_V_PER_G = 2.5, 4.0
ZERO_COUNTS, COUNTS_PER_C = 197, -1.083
DEFAULT_RATE_HZ = 10
# 260 nV rms (AD7730 data sheet, +-80 mV, 200 Hz, chopped) over 9.54 nV per code.
ADC_NOISE_CODES = 27.0
# A `$T` line has 43 bytes, each with a start and a stop bit.
LINE_S = 43 * 10 / BAUD
# Length of a burst of conversions. As in the firmware, a sample is the mean of the bursts in its period.
WINDOW_MS = 20
# How soon a stop is noticed while nothing is due.
POLL_S = 0.2


def checksum(body: bytes) -> int:
    """Compute the CRC-16/XMODEM (polynomial 0x1021, start 0) of the bytes between '$' and '*'."""
    return crc_hqx(body, 0)


def frame(body: bytes) -> bytes:
    """Make the line of a body: `$body*CRC` CR LF."""
    return b"$%s*%04X\r\n" % (body, checksum(body))


def sample_line(sequence: int, milliseconds: int, x: int, y: int, temperature: int, status: int) -> bytes:
    """Make a `$T` line; sequence and milliseconds wrap at 16 and 32 bits."""
    numbers = (sequence & 0xFFFF, milliseconds & 0xFFFFFFFF, x, y, temperature, status)
    return frame(b"T,%04X,%08X,%06X,%06X,%02X,%02X" % numbers)


def identity_line(
    rate_hz: int, delay_ms: int, *, version: int = 1, firmware: int = 0x0100, unit: int = 7, kind: int = 0
) -> bytes:
    """Make a `$I` line."""
    numbers = (version, firmware, unit, rate_hz, delay_ms, kind)
    return frame(b"I,%02X,%04X,%08X,%02X,%04X,%02X" % numbers)


def pulse_line(
    *, channel: int, rising: bool, number: int, bounces: int, milliseconds: int, microseconds: int
) -> bytes:
    """Make a `$P` line; channel: 0 shutter, 1 second."""
    kind = channel | (RISING if rising else 0)
    return frame(b"P,%02X,%02X,%02X,%08X,%04X" % (kind, number, bounces, milliseconds, microseconds))


def refusal_line(reason: int) -> bytes:
    return frame(b"N,%02X" % reason)


def code_of(volts: float, divider: float = DIVIDER, reference_v: float = REFERENCE_V) -> int:
    """Code of a sensor's output voltage, limited to the converter's range; both share their supply."""
    per_code = divider * ADC_RANGE_V * reference_v / REFERENCE_V / CODE_ZERO
    return min(max(CODE_ZERO + round((volts - reference_v / 2) / per_code), 0), CODE_MAX)


def temperature_counts(celsius: float) -> int:
    """The sensor's temperature counts, limited to 8 bits."""
    return min(max(round(ZERO_COUNTS + COUNTS_PER_C * celsius), 0), 255)


def _fault(what: str) -> Any:
    """Make a field of Faults: the probability that this happens."""
    return field(default=0.0, metadata={"help": what})


@dataclass(frozen=True)
class Faults:
    """Probabilities of faults: per line, except `flip`, which is per bit."""

    garbage: float = _fault("random bytes before the line")
    drop: float = _fault("the line is lost")
    truncate: float = _fault("the line ends early")
    double: float = _fault("the line comes twice")
    flip: float = _fault("the bit is flipped")

    def apply(self, line: bytes, rng: random.Random) -> bytes:
        """Return the bytes that arrive when a line is sent."""
        if not any((self.garbage, self.drop, self.truncate, self.double, self.flip)):
            return line
        if rng.random() < self.drop:
            line = b""
        if rng.random() < self.truncate:
            line = line[: rng.randrange(len(line) + 1)]
        if rng.random() < self.double:
            line += line
        if self.flip:
            flips = (sum((rng.random() < self.flip) << bit for bit in range(8)) for _ in line)
            line = bytes(byte ^ flip for byte, flip in zip(line, flips, strict=True))
        if rng.random() < self.garbage:
            line = rng.randbytes(rng.randrange(1, 64)) + line
        return line


def delay_ms(rate_hz: int) -> int:
    """Time from the middle of a sample to its line, as in the firmware."""
    bursts = 1000 // WINDOW_MS // rate_hz
    return bursts * WINDOW_MS // 2 + 4


class Mcu:
    """The device: it takes tilts and gives bytes. Times are seconds of one clock that does not step.

    tilt: called with the time of a sample, returns (x, y) rad.
    noise_rad: standard deviation of the white noise on each axis.
    """

    def __init__(
        self,
        tilt: Callable[[float], tuple[float, float]] = lambda now: (0.0, 0.0),
        noise_rad: float = math.radians(0.0035),
        temperature_c: float = 20.0,
        rate_hz: int = DEFAULT_RATE_HZ,
        drift_ppm: float = 0.0,
        seed: int | None = None,
    ) -> None:
        self.tilt = tilt
        self.noise_rad = noise_rad
        self.temperature_c = temperature_c
        # The ADC repeats its last codes.
        self.frozen = False
        self._power_up_rate = rate_hz
        self._tick = 1.0 + drift_ppm * 1e-6
        self._rng = random.Random(seed)
        # Bytes of a command that is not complete.
        self._received = b""
        self._codes = (CODE_ZERO, CODE_ZERO)
        self.reset(0.0)

    def reset(self, now: float) -> bytes:
        """Power up and return the first bytes that it sends."""
        self._boot = now
        self._rate_hz = self._power_up_rate
        self._sequence = 0
        self._status = FIRST
        self._next = now + self._period
        return self._identify()

    @property
    def _period(self) -> float:
        """Time from one sample to the next, as its own clock runs."""
        return 1 / (self._rate_hz * self._tick)

    @property
    def due(self) -> float:
        """Time at which the next line has been sent."""
        return self._next + delay_ms(self._rate_hz) * 1e-3 + LINE_S

    def sample(self) -> bytes:
        """Take the next sample and return its line."""
        at = self._next
        self._next = at + self._period
        if not self.frozen:
            x, y = self.tilt(at)
            self._codes = (self._code(x), self._code(y))
        counts = temperature_counts(self.temperature_c)
        ms = int((at - self._boot) * self._tick * 1e3)
        line = sample_line(self._sequence, ms, *self._codes, counts, self._status)
        self._sequence += 1
        self._status = 0
        return line

    def skip_to(self, now: float) -> None:
        """Drop the lines that were due long before `now`: the host was asleep, or this did not run."""
        if self.due < now - 1.0:
            missed = int((now - self.due) / self._period)
            self._sequence += missed
            self._next += missed * self._period

    def receive(self, data: bytes) -> bytes:
        """Return the answers to bytes from the host."""
        data, answers, end = self._received + data, b"", 0
        for match in COMMAND.finditer(data):
            end = match.end()
            answers += self._answer(match[1], int(match[2], 16) == checksum(match[1]))
        self._received = data[end:][-48:]
        return answers

    def _answer(self, body: bytes, right: bool) -> bytes:
        rate = re.fullmatch(rb"R,([0-9A-F]{2})", body)
        if not right:
            return refusal_line(CHECKSUM)
        if rate and not 1 <= int(rate[1], 16) <= MAX_RATE_HZ:
            return refusal_line(OUT_OF_RANGE)
        if rate:
            self._next -= self._period
            self._rate_hz = int(rate[1], 16)
            self._next += self._period
        elif body != b"Q":
            return refusal_line(UNKNOWN)
        return self._identify()

    def _identify(self) -> bytes:
        return identity_line(
            self._rate_hz, delay_ms(self._rate_hz), version=PROTOCOL_VERSION, firmware=FIRMWARE, unit=UNIT
        )

    def _code(self, angle: float) -> int:
        angle += self._rng.gauss(0.0, self.noise_rad) if self.noise_rad else 0.0
        # The sensor's output ends at the rails.
        volts = min(max(OFFSET_V + SENSITIVITY_V_PER_G * math.sin(angle), 0.0), REFERENCE_V)
        code = code_of(volts)
        noisy = code + round(self._rng.gauss(0.0, ADC_NOISE_CODES))
        return min(max(noisy, 0), CODE_MAX) if 0 < code < CODE_MAX else code


class Pty:
    """A pseudo-terminal; `path` is the host's end (a symbolic link to it is made if one is asked for)."""

    def __init__(self, link: str | None = None) -> None:
        self._link = link
        self.fd, host = os.openpty()
        tty.setraw(host)
        self.path = os.ttyname(host)
        # With the host's end closed here, poll shows whether anyone listens: a cable stores no bytes.
        os.close(host)
        os.set_blocking(self.fd, False)
        if link:
            self._make_link(link)

    def _make_link(self, link: str) -> None:
        if os.path.lexists(link) and not os.path.islink(link):
            os.close(self.fd)
            raise FileExistsError(errno.EEXIST, "exists and is no symbolic link", link)
        temporary = f"{link}.{os.getpid()}"
        os.symlink(self.path, temporary)
        os.replace(temporary, link)

    @property
    def connected(self) -> bool:
        poll = select.poll()
        poll.register(self.fd, select.POLLIN)
        return not any(event & select.POLLHUP for _, event in poll.poll(0))

    def write(self, data: bytes) -> None:
        """Send bytes; without a reader they are lost."""
        if data and self.connected:
            with contextlib.suppress(BlockingIOError):
                os.write(self.fd, data)

    def read(self) -> bytes:
        """Return the bytes that the host has sent; empty without any, or without a host."""
        try:
            return os.read(self.fd, 4096)
        except OSError:
            return b""

    def close(self) -> None:
        """Close the cable and remove its link."""
        if self.fd >= 0:
            os.close(self.fd)
            self.fd = -1
        if self._link and os.path.islink(self._link) and os.readlink(self._link) == self.path:
            os.unlink(self._link)


class Emulator:
    """Runs an Mcu on a Pty in real time."""

    def __init__(
        self, mcu: Mcu, link: str | None = None, faults: Faults = Faults(), reset_every_s: float = 0.0
    ) -> None:
        self._mcu = mcu
        self._faults = faults
        self._reset_every_s = reset_every_s
        self._rng = random.Random(0)
        self.pty = Pty(link)

    def run(self, stopped: Callable[[], bool]) -> None:
        """Run until stopped() is true, which is asked at least every POLL_S; then close the cable."""
        mcu, pty = self._mcu, self.pty
        try:
            pty.write(mcu.reset(time.monotonic()))
            next_reset = time.monotonic() + (self._reset_every_s or math.inf)
            while not stopped():
                now = time.monotonic()
                if now >= next_reset:
                    next_reset = now + self._reset_every_s
                    pty.write(mcu.reset(now))
                mcu.skip_to(now)
                while mcu.due <= now:
                    pty.write(self._faults.apply(mcu.sample(), self._rng))
                self._wait(min(mcu.due - time.monotonic(), POLL_S))
                pty.write(mcu.receive(pty.read()))
        finally:
            pty.close()

    def _wait(self, seconds: float) -> None:
        """Wait for the time, or until the host has sent something."""
        # Without a host the master end is always readable (hung up), so only the time counts then.
        watched = [self.pty.fd] if self.pty.connected else []
        select.select(watched, [], [], max(seconds, 0.0))


def main() -> int:
    """Run the command `emulator` until SIGINT or SIGTERM."""
    from starpos_common.node_main import stop_signals

    with stop_signals() as stopped:
        return serve(sys.argv[1:], stopped)


def serve(arguments: list[str], stopped: list[int]) -> int:
    """Emulate the device of the command line until a signal handler puts something into `stopped`; return exit status."""
    options = _parser().parse_args(arguments)
    tilt = (math.radians(options.tilt_x), math.radians(options.tilt_y))
    mcu = Mcu(
        lambda now: tilt,
        math.radians(options.noise),
        options.temperature,
        options.rate,
        options.drift_ppm,
        options.seed,
    )
    mcu.frozen = options.freeze
    faults = Faults(**{f.name: getattr(options, f.name) for f in fields(Faults)})
    try:
        emulator = Emulator(mcu, options.link, faults, options.reset_every)
    except OSError as error:
        print(f"emulator: {options.link}: {error.strerror}; choose another --link.", file=sys.stderr)
        return 1
    print(f"emulated inclinometer on {options.link or emulator.pty.path}", flush=True)
    emulator.run(lambda: bool(stopped))
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="emulator", description="An emulated inclinometer on a pseudo-terminal, until it is interrupted."
    )
    number = _number
    add = parser.add_argument
    add("--link", metavar="PATH", help="make the serial port appear under this stable path (a symbolic link)")
    for axis in "xy":
        words = f"elevation of the sensor's {axis.upper()}' axis (0)"
        add(f"--tilt-{axis}", type=number(-90, 90), default=0.0, metavar="DEG", help=words)
    add(
        "--noise",
        type=number(0, 10),
        default=0.0035,
        metavar="DEG",
        help="white noise of a sample (%(default)s)",
    )
    add("--temperature", type=number(-40, 125), default=20.0, metavar="C", help="of the sensor (20)")
    add(
        "--rate",
        type=int,
        choices=range(1, MAX_RATE_HZ + 1),
        default=DEFAULT_RATE_HZ,
        metavar="HZ",
        help="samples a second (%(default)s)",
    )
    add(
        "--drift-ppm",
        type=number(-5e4, 5e4),
        default=0.0,
        metavar="PPM",
        help="error of the microcontroller's clock (0)",
    )
    add("--seed", type=int, help="of the noise, for the same samples every time")
    faults = parser.add_argument_group("faults", "P is the probability for each line, of --flip for each bit")
    for fault in fields(Faults):
        faults.add_argument(
            f"--{fault.name}", type=number(0, 1), default=0.0, metavar="P", help=fault.metadata["help"]
        )
    faults.add_argument(
        "--reset-every",
        type=number(0, 1e9),
        default=0.0,
        metavar="S",
        help="reset the microcontroller every S seconds (0: never)",
    )
    faults.add_argument("--freeze", action="store_true", help="the converter repeats one value")
    return parser


def _number(low: float, high: float) -> Callable[[str], float]:
    def convert(text: str) -> float:
        value = float(text)
        if not low <= value <= high:
            raise argparse.ArgumentTypeError(f"{text} is not from {low:g} to {high:g}")
        return value

    convert.__name__ = "number"
    return convert

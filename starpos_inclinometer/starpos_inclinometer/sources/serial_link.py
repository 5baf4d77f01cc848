# SPDX-License-Identifier: Apache-2.0
"""The serial port: a thread opens and reads it, and opens it again when the device comes back."""

import contextlib
import errno
import fcntl
import os
import termios
from collections.abc import Mapping
from typing import Any, Generic, Protocol, TypeVar

import serial

from starpos_inclinometer.clock import Moment
from starpos_inclinometer.sources import mcu_protocol
from starpos_inclinometer.sources.source import Arrival, Counts, Link, Phase, Surroundings

# How soon a stop, a command or silence is noticed.
READ_TIMEOUT_S = 0.1
MIN_SILENCE_S, SILENT_PERIODS = 1.0, 1.5
# Lines of which none is used are reported after this multiple of the patience with silence.
UNFIT_PATIENCES = 3.0
READ_BYTES = 4096
# pseudo-terminals, Linux's devices.txt.
PTY_MAJORS = range(136, 144)

# pyserial raises its own error, passes on some errors of the system, and raises TypeError if its descriptor is gone.
PORT_ERRORS = (OSError, termios.error, serial.SerialException, TypeError, ValueError)


def port_refusal(values: Mapping[str, Any]) -> str | None:
    """Say in a sentence that no port is named; None if one is."""
    if values["port"].strip():
        return None
    return "parameter port must name the serial port, such as /dev/serial/by-id/...; it is empty."


class Decoder(Protocol):
    """Decodes the bytes of a device and makes its commands. The link's thread uses it."""

    # What to do if bytes come but no lines.
    hint: str

    counts: Counts

    @property
    def period_s(self) -> float:
        """Time from one sample to the next."""

    def decode(self, data: bytes, moment: Moment) -> list[Arrival]:
        """Take bytes that were read at that moment; return the samples that are believed now; never raises."""

    def resume(self) -> None:
        """Start again, because the connection was opened again."""

    def command(self) -> bytes:
        """The command that the device needs now; empty if it needs none."""

    @property
    def command_period_s(self) -> float:
        """Time from one command to the next, unless it was answered."""

    @property
    def answered(self) -> bool:
        """Whether the last bytes answered a command, so that the next command need not wait."""


D = TypeVar("D", bound=Decoder)


class SerialLink(Link, Generic[D]):
    """Reads the samples that come through a serial port.

    values: the node's parameters; the port is resolved at each opening, and opened exclusively.
    """

    def __init__(self, host: Surroundings, values: Mapping[str, Any], decoder: D) -> None:
        super().__init__(host, values["port"])
        self._baud, self._decoder, self._next_command = values["baud"], decoder, 0.0
        self._counts = decoder.counts

    def _serve(self) -> None:
        device = None
        try:
            device = self._open()
            self._read(device)
        except PORT_ERRORS as error:
            self._enter(Phase.ABSENT, self._explain(error, opened=device is not None))
        finally:
            if device is not None:
                # If the device is gone there is nothing left to close.
                with contextlib.suppress(*PORT_ERRORS):
                    device.close()

    def _open(self) -> serial.Serial:
        device = serial.Serial(
            self.name, self._baud, timeout=READ_TIMEOUT_S, write_timeout=0.5, exclusive=True
        )
        # pyserial's lock stops only programs that ask for it; this stops all but root's. A pseudo-terminal is left out:
        # it would stay locked after a reader was killed, as long as its other end is open.
        if os.major(os.fstat(device.fileno()).st_rdev) not in PTY_MAJORS:
            fcntl.ioctl(device.fileno(), termios.TIOCEXCL)
        return device

    def _read(self, device: serial.Serial) -> None:
        """Read until the link is stopped or the path leads to another device; raises when something goes wrong."""
        with self._lock:
            self._connections += 1
            self._decoder.resume()
        last_byte = last_line = last_sample = self._clock.monotonic_s()
        self._next_command = 0.0
        while not self._stop.is_set():
            data = device.read(max(1, min(device.in_waiting, READ_BYTES)))
            moment = self._clock.read()
            now = moment.monotonic_s
            if data:
                last_byte = now
                lines, samples = self._receive(data, moment)
                last_line = now if lines else last_line
                last_sample = now if samples else last_sample
            if now >= self._next_command and (command := self._decoder.command()):
                device.write(command)
                self._next_command = now + self._decoder.command_period_s
            patience = max(MIN_SILENCE_S, SILENT_PERIODS * self._decoder.period_s)
            if now - last_byte > patience:
                self._enter(
                    Phase.SILENT, f"{self.name} is open but silent: check the device's power and cable."
                )
                # The path may lead to another device now; OSError if it leads nowhere.
                if os.stat(self.name).st_rdev != os.fstat(device.fileno()).st_rdev:
                    return
            elif now - last_line > patience:
                self._enter(
                    Phase.GARBLED,
                    f"{self.name} sends bytes but no valid lines at {self._baud} baud: " + self._decoder.hint,
                )
            elif now - last_sample > UNFIT_PATIENCES * patience:
                self._enter(
                    Phase.GARBLED,
                    f"{self.name} sends lines that do not fit one another: check cable and grounding.",
                )

    def _receive(self, data: bytes, moment: Moment) -> tuple[bool, bool]:
        """Take bytes; return whether they held valid lines, and samples."""
        with self._lock:
            before = self._counts.good
            arrivals = self._decoder.decode(data, moment)
            lines = self._counts.good > before
        if self._decoder.answered:
            self._next_command = 0.0
        if arrivals:
            samples = [a for a in arrivals if not isinstance(a.sample, mcu_protocol.Pulse)]
            self._admit(arrivals, [moment.monotonic_s] * len(samples), f"receiving from {self.name}")
        return lines, bool(arrivals)

    def _explain(self, error: Exception, opened: bool) -> str:
        code = getattr(error, "errno", None)
        if opened:
            return f"{self.name} went away: plug the inclinometer in again; it is retried."
        if code in (errno.ENOENT, errno.ENODEV, errno.ENXIO):
            return f"{self.name} is not there: plug the inclinometer in, or set `port`; it is retried."
        if code in (errno.EACCES, errno.EPERM):
            return f"{self.name} may not be opened: add the user to its group (dialout); it is retried."
        if code in (errno.EAGAIN, errno.EBUSY):
            return f"{self.name} is in use by another process: end that one; it is retried."
        text = " ".join(str(error).split())
        return f"{self.name} is no usable serial port ({text}): set `port` to the device; it is retried."

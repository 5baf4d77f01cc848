# SPDX-License-Identifier: Apache-2.0
"""The serial port: a thread opens and reads it, and opens it again when the device comes back."""

import contextlib
import errno
import fcntl
import os
import termios
import threading
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol

import serial

from starpos_inclinometer.clock import HostClock, Moment, Step
from starpos_inclinometer.sources import mcu_protocol
from starpos_inclinometer.sources.source import Arrival, Counts, Phase

# A device that came back is read again within a second.
RETRY_S = 0.4
# How soon a stop, a command or silence is noticed.
READ_TIMEOUT_S = 0.1
MIN_SILENCE_S, SILENT_PERIODS = 1.0, 1.5
# Lines of which none is used are reported after this multiple of the patience with silence.
UNFIT_PATIENCES = 3.0
READ_BYTES = 4096
# 10 s at the highest rate.
QUEUE_SAMPLES = 512
RATE_WINDOW_S = 5.0
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
    """Decodes the bytes of a device and makes its commands. The link's thread uses it; any thread may read `counts`."""

    # What to do if bytes come but no lines.
    hint: str

    @property
    def counts(self) -> Counts: ...

    @property
    def period_s(self) -> float:
        """Time from one sample to the next."""

    def feed(self, data: bytes, moment: Moment) -> list[Arrival]:
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


@dataclass(frozen=True, kw_only=True)
class LinkState:
    """State of the link, for a person to read."""

    phase: Phase = Phase.ABSENT
    sentence: str = "the port has not been opened yet"
    counts: Counts = field(default_factory=Counts)
    # How often the port was opened.
    connections: int = 0
    # Samples that were not fetched in time.
    dropped: int = 0
    # Rate of the recent samples.
    rate_hz: float = 0.0
    # The last step of the host's clock.
    step: Step | None = None


class SerialLink:
    """Reads samples from `port` until `stop`.

    port: use a stable path (/dev/serial/by-id/...); it is resolved at each opening, and opened exclusively.
    clock: read once for each chunk of bytes.
    wake: called from the reader's thread when there are samples to take or the phase changed; it must be quick.
    """

    def __init__(
        self,
        port: str,
        baud: int,
        decoder: Decoder,
        clock: HostClock,
        wake: Callable[[], object] = lambda: None,
    ) -> None:
        self._port = port
        self._baud = baud
        self._decoder = decoder
        self._clock = clock
        self._wake = wake
        self._queue: deque[Arrival] = deque(maxlen=QUEUE_SAMPLES)
        self._recent: deque[float] = deque(maxlen=int(RATE_WINDOW_S * 64))
        self._lock = threading.Lock()
        self._phase = Phase.ABSENT
        self._sentence = LinkState.sentence
        self._connections = self._dropped = 0
        self._next_command = 0.0
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="serial link", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def stop(self) -> None:
        """Close the port and end the thread; takes at most a few READ_TIMEOUT_S."""
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join(timeout=5.0)

    def take(self) -> list[Arrival]:
        """Return the samples since the last call, in order."""
        taken = []
        with self._lock:
            while self._queue:
                taken.append(self._queue.popleft())
        return taken

    def state(self) -> LinkState:
        with self._lock:
            horizon = self._clock.monotonic_s() - RATE_WINDOW_S
            recent = [t for t in self._recent if t >= horizon]
            span = recent[-1] - recent[0] if len(recent) > 1 else 0.0
            return LinkState(
                phase=self._phase,
                sentence=self._sentence,
                counts=self._decoder.counts,
                connections=self._connections,
                dropped=self._dropped,
                rate_hz=(len(recent) - 1) / span if span > 0 and self._phase is Phase.RECEIVING else 0.0,
                step=self._clock.step,
            )

    # All that follows runs in the reader's thread.

    def _run(self) -> None:
        while not self._stop.is_set():
            device = None
            try:
                device = self._open()
                self._serve(device)
            except PORT_ERRORS as error:
                self._enter(Phase.ABSENT, self._explain(error, opened=device is not None))
            finally:
                if device is not None:
                    _close(device)
            self._clock.read()
            self._stop.wait(RETRY_S)

    def _open(self) -> serial.Serial:
        device = serial.Serial(
            self._port, self._baud, timeout=READ_TIMEOUT_S, write_timeout=0.5, exclusive=True
        )
        # pyserial's lock stops only programs that ask for it; this stops all but root's. A pseudo-terminal is left out:
        # it would stay locked after a reader was killed, as long as its other end is open.
        if os.major(os.fstat(device.fileno()).st_rdev) not in PTY_MAJORS:
            fcntl.ioctl(device.fileno(), termios.TIOCEXCL)
        return device

    def _serve(self, device: serial.Serial) -> None:
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
                    Phase.SILENT, f"{self._port} is open but silent: check the device's power and cable."
                )
                if self._moved(device):
                    return
            elif now - last_line > patience:
                self._enter(
                    Phase.GARBLED,
                    f"{self._port} sends bytes but no valid lines at {self._baud} baud: "
                    + self._decoder.hint,
                )
            elif now - last_sample > UNFIT_PATIENCES * patience:
                self._enter(
                    Phase.GARBLED,
                    f"{self._port} sends lines that do not fit one another: check cable and grounding.",
                )

    def _receive(self, data: bytes, moment: Moment) -> tuple[bool, bool]:
        """Take bytes; return whether they held valid lines, and samples."""
        with self._lock:
            before = self._decoder.counts.good
            arrivals = self._decoder.feed(data, moment)
            for arrival in arrivals:
                self._dropped += len(self._queue) == QUEUE_SAMPLES
                self._queue.append(arrival)
                if not isinstance(arrival.sample, mcu_protocol.Pulse):
                    self._recent.append(moment.monotonic_s)
            if self._decoder.answered:
                self._next_command = 0.0
            lines = self._decoder.counts.good > before
        if arrivals:
            self._enter(Phase.RECEIVING, f"receiving from {self._port}")
            self._wake()
        return lines, bool(arrivals)

    def _moved(self, device: serial.Serial) -> bool:
        """Whether the path now leads to another device than the open one; OSError if it leads nowhere."""
        return os.stat(self._port).st_rdev != os.fstat(device.fileno()).st_rdev

    def _enter(self, phase: Phase, sentence: str) -> None:
        with self._lock:
            changed = (phase, sentence) != (self._phase, self._sentence)
            self._phase, self._sentence = phase, sentence
        if changed:
            self._wake()

    def _explain(self, error: Exception, opened: bool) -> str:
        code = getattr(error, "errno", None)
        if opened:
            return f"{self._port} went away: plug the inclinometer in again; it is retried."
        if code in (errno.ENOENT, errno.ENODEV, errno.ENXIO):
            return f"{self._port} is not there: plug the inclinometer in, or set `port`; it is retried."
        if code in (errno.EACCES, errno.EPERM):
            return f"{self._port} may not be opened: add the user to its group (dialout); it is retried."
        if code in (errno.EAGAIN, errno.EBUSY):
            return f"{self._port} is in use by another process: end that one; it is retried."
        text = " ".join(str(error).split())
        return f"{self._port} is no usable serial port ({text}): set `port` to the device; it is retried."


def _close(device: serial.Serial) -> None:
    # If the device is gone there is nothing left to close.
    with contextlib.suppress(*PORT_ERRORS):
        device.close()

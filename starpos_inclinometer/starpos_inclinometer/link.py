# SPDX-License-Identifier: Apache-2.0
"""The serial port: a thread that opens and reads it, sets the MCU's rate, comes back when the device does."""

import contextlib
import errno
import os
import termios
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from enum import Enum

import serial

from starpos_inclinometer.protocol import (
    BAUD,
    Counts,
    Identity,
    Parser,
    Reason,
    Refusal,
    Sample,
    identify_command,
    rate_command,
)

RETRY_S = 0.4  # so that a device that came back is read again within a second
READ_TIMEOUT_S = 0.1  # how soon a stop, a command or silence is noticed
COMMAND_RETRY_S = 1.0
MIN_SILENCE_S = 1.0
READ_BYTES = 4096
QUEUE_SAMPLES = 512  # 10 s at the highest rate
RATE_WINDOW_S = 5.0

# pyserial raises its own error, passes some of the system's through, and a TypeError where its fd has gone.
PORT_ERRORS = (OSError, termios.error, serial.SerialException, TypeError, ValueError)


class Phase(Enum):
    """How the link stands."""

    ABSENT = "absent"  # the port cannot be opened, or it went
    SILENT = "silent"  # open, but nothing comes
    GARBLED = "garbled"  # bytes come, but no samples
    RECEIVING = "receiving"


@dataclass(frozen=True)
class LinkState:
    """The link as a person wants to know it."""

    phase: Phase = Phase.ABSENT
    sentence: str = "the port has not been opened yet"
    identity: Identity | None = None
    refused: bool = False  # the MCU refused the rate that was asked for
    counts: Counts = field(default_factory=Counts)
    connections: int = 0  # how often the port was opened
    dropped: int = 0  # samples nobody fetched in time
    rate_hz: float = 0.0  # as they came in lately


@dataclass(frozen=True, slots=True)
class Arrival:
    """A sample, and when its line was read: on the monotonic clock (s) and on the caller's (ns)."""

    sample: Sample
    monotonic_s: float
    caller_ns: int


class SerialLink:
    """Reads samples from `port` until `stop`.

    port: use a stable path (/dev/serial/by-id/...); it is resolved at each opening, and opened exclusively.
    now_ns: the caller's clock, read once for each chunk of bytes.  wake: called from the reader's thread when
    there are samples to take or the phase changed; must be quick.
    """

    def __init__(
        self,
        port: str,
        rate_hz: int,
        now_ns: Callable[[], int] = time.time_ns,
        wake: Callable[[], None] = lambda: None,
        baud: int = BAUD,
    ):
        self._port = port
        self._baud = baud
        self._now_ns = now_ns
        self._wake = wake
        self._wanted_rate = rate_hz
        self._refused_rate: int | None = None
        self._parser = Parser()
        self._queue: deque[Arrival] = deque(maxlen=QUEUE_SAMPLES)
        self._recent: deque[float] = deque(maxlen=int(RATE_WINDOW_S * 64))
        self._lock = threading.Lock()
        self._phase = Phase.ABSENT
        self._sentence = LinkState.sentence
        self._identity: Identity | None = None
        self._connections = self._dropped = 0
        self._next_command = 0.0
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="serial link", daemon=True)

    def start(self):
        self._thread.start()

    def stop(self):
        """Close the port and end the thread; takes at most a few READ_TIMEOUT_S."""
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join(timeout=5.0)

    def set_rate(self, rate_hz: int):
        """Ask the MCU for another rate; it is asked again after each reset and each opening."""
        self._wanted_rate = rate_hz

    def take(self) -> list[Arrival]:
        """The samples that have come since the last call, in order."""
        taken = []
        with self._lock:
            while self._queue:
                taken.append(self._queue.popleft())
        return taken

    def state(self) -> LinkState:
        with self._lock:
            horizon = time.monotonic() - RATE_WINDOW_S
            recent = [t for t in self._recent if t >= horizon]
            span = recent[-1] - recent[0] if len(recent) > 1 else 0.0
            return LinkState(
                self._phase,
                self._sentence,
                self._identity,
                self._refused_rate == self._wanted_rate,
                self._parser.counts,
                self._connections,
                self._dropped,
                (len(recent) - 1) / span if span > 0 and self._phase is Phase.RECEIVING else 0.0,
            )

    # The rest runs in the thread.

    def _run(self):
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
            self._stop.wait(RETRY_S)

    def _open(self) -> serial.Serial:
        return serial.Serial(
            self._port, self._baud, timeout=READ_TIMEOUT_S, write_timeout=0.5, exclusive=True
        )

    def _serve(self, device: serial.Serial):
        """Read until the link is stopped or the path leads elsewhere; raises when something goes wrong."""
        with self._lock:
            self._connections += 1
            self._identity = None
            self._refused_rate = None
            self._parser.resume()
        last_sample = last_byte = time.monotonic()
        self._next_command = 0.0
        while not self._stop.is_set():
            data = device.read(max(1, min(device.in_waiting, READ_BYTES)))
            now = time.monotonic()
            if data:
                last_byte = now
                if self._receive(data, now):
                    last_sample = now
            if now >= self._next_command and (command := self._command()):
                device.write(command)
                self._next_command = now + COMMAND_RETRY_S
            if now - last_sample > self._patience():
                if now - last_byte > self._patience():
                    self._enter(
                        Phase.SILENT, f"{self._port} is open but silent: check the device's power and cable."
                    )
                    if self._moved(device):
                        return
                else:
                    self._enter(
                        Phase.GARBLED,
                        f"{self._port} sends bytes but no valid lines at {self._baud} baud: "
                        "check the baud rate, and that this is the inclinometer.",
                    )

    def _patience(self) -> float:
        rate = self._identity.rate_hz if self._identity else self._wanted_rate
        return max(MIN_SILENCE_S, 2.5 / max(rate, 1))

    def _receive(self, data: bytes, now: float) -> bool:
        """Whether there was a sample among the data."""
        stamp = self._now_ns()
        any_sample = False
        with self._lock:
            for message in self._parser.feed(data):
                if isinstance(message, Sample):
                    any_sample = True
                    self._dropped += len(self._queue) == QUEUE_SAMPLES
                    self._queue.append(Arrival(message, now, stamp))
                    self._recent.append(now)
                    if message.restarted:
                        # After a reset it is at the default rate, perhaps with another firmware.
                        self._identity = None
                    continue
                self._next_command = 0.0  # it has answered
                if isinstance(message, Identity):
                    self._identity = message
                elif isinstance(message, Refusal) and message.reason == Reason.OUT_OF_RANGE:
                    self._refused_rate = self._wanted_rate
        if any_sample:
            self._enter(Phase.RECEIVING, f"receiving from {self._port}")
            self._wake()
        return any_sample

    def _command(self) -> bytes | None:
        """What to tell the MCU so that it is as it should be; None where it is."""
        if self._identity is None:
            return identify_command()
        if self._identity.rate_hz != self._wanted_rate and self._refused_rate != self._wanted_rate:
            return rate_command(self._wanted_rate)
        return None

    def _moved(self, device: serial.Serial) -> bool:
        """Whether the path now leads to another device than the open one; OSError where it leads nowhere."""
        return os.stat(self._port).st_rdev != os.fstat(device.fileno()).st_rdev

    def _enter(self, phase: Phase, sentence: str):
        with self._lock:
            changed = (phase, sentence) != (self._phase, self._sentence)
            self._phase, self._sentence = phase, sentence
            if phase is Phase.ABSENT:
                self._identity = None
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


def _close(device: serial.Serial):
    # Where the device has gone there is nothing left to close.
    with contextlib.suppress(*PORT_ERRORS):
        device.close()

# SPDX-License-Identifier: Apache-2.0
"""Interface between the node and a sensor, and the link to a sensor that a thread reads.

A new sensor is a TiltSource in a module here, and a line in `registry`.
"""

import threading
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from enum import Enum
from typing import Any

from rclpy.node import Node

from starpos.messages.tilt import Reading
from starpos_inclinometer.clock import HostClock, Moment
from starpos_interfaces.msg import Pulse

# A device that came back is read again within a second.
RETRY_S = 0.4
# 20 s at the board's highest rate.
QUEUE = 1024
RATE_WINDOW_S = 5.0


class Phase(Enum):
    """State of a source."""

    # The port cannot be opened, or it went away; the topic has no publisher.
    ABSENT = "absent"
    # Open, but nothing comes.
    SILENT = "silent"
    # Bytes come, but no samples.
    GARBLED = "garbled"
    # Samples come, but the instrument moves and they give no tilt.
    MOVING = "moving"
    RECEIVING = "receiving"


@dataclass(slots=True, kw_only=True)
class Counts:
    """Numbers of the lines, or of the messages of a topic, since the source was made; what reads them counts on."""

    # Samples with the right checksum and form.
    good: int = 0
    # Framed lines with the wrong checksum.
    crc_errors: int = 0
    # Lines of another form, messages with NaN or without a stamp.
    malformed: int = 0
    # Bytes outside of lines.
    garbage_bytes: int = 0
    # Samples missing in the sequence.
    lost: int = 0
    # Samples that came twice; dropped.
    duplicates: int = 0
    # Resets of the device.
    restarts: int = 0
    # Samples that did not fit the others; dropped.
    implausible: int = 0


@dataclass(frozen=True, slots=True)
class Arrival:
    """A sample of any kind, and when it was read."""

    sample: Any
    moment: Moment
    # The device when it sent this: its identity, or itself.
    identity: Any = None
    # Whether it was read soon after it was measured.
    dated: bool = True


@dataclass(frozen=True, kw_only=True)
class Health:
    """State of a source, for a person to read."""

    phase: Phase
    sentence: str
    # Rate of the recent samples.
    rate_hz: float = 0.0
    counts: Counts = field(default_factory=Counts)
    # What is wrong although samples come.
    complaint: str = ""
    values: Mapping[str, object] = field(default_factory=dict)


@dataclass(frozen=True)
class Surroundings:
    """What a node gives its source: itself, for topics; the host's clock; `wake`, which any thread may call."""

    node: Node
    clock: HostClock
    wake: Callable[[], object]


class TiltSource:
    """A source of tilts, made as SourceClass(host, values) from the node's parameters.

    Only the node's thread calls it.
    """

    # The port or topic of the device, for diagnostics.
    name: str

    def __init__(self, host: Surroundings, values: Mapping[str, Any]) -> None:
        raise NotImplementedError

    @staticmethod
    def refusal(values: Mapping[str, Any]) -> str | None:
        """Say in a sentence why a source cannot be made of these parameters; None if it can."""
        return None

    def start(self) -> None:
        """Begin to listen."""

    def stop(self) -> None:
        """End everything that `start` began; takes at most a second."""

    def restart(self) -> None:
        """Forget what came of topics: a replay begins."""

    def configure(self, values: Mapping[str, Any]) -> None:
        """Apply the parameters that may change at run time."""

    def fetch(self) -> list[Reading]:
        """Return the readings since the last call, in order."""
        raise NotImplementedError

    def fetch_pulses(self) -> list[Pulse]:
        """Return the edges that the device has timed since the last call, with their times; most devices time none."""
        return []

    def health(self) -> Health:
        """State of the source, for a person to read."""
        raise NotImplementedError


def rate_of(times_s: Iterable[float], now_s: float) -> float:
    """Rate (Hz) of the samples of the last seconds, by their monotonic times in order."""
    recent = [t for t in times_s if now_s - t <= RATE_WINDOW_S]
    span_s = recent[-1] - recent[0] if recent else 0.0
    return (len(recent) - 1) / span_s if span_s > 0 else 0.0


class Link(TiltSource):
    """A source whose device a thread reads until `stop`, and opens again when it comes back.

    host: its clock is read at least once a second; `wake` is called from the thread when there is something to fetch or
    the phase changed, and must be quick.
    """

    def __init__(self, host: Surroundings, name: str) -> None:
        self.name, self._clock, self._wake = name, host.clock, host.wake
        self._counts = Counts()
        self._queue: deque[Arrival] = deque(maxlen=QUEUE)
        self._recent: deque[float] = deque(maxlen=QUEUE)
        # Of all that both threads use.
        self._lock = threading.Lock()
        self._phase, self._sentence = Phase.ABSENT, "the device has not been opened yet"
        self._connections = self._dropped = 0
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

    def start(self) -> None:
        self._thread.start()

    def stop(self) -> None:
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join(timeout=5.0)

    def arrivals(self) -> list[Arrival]:
        """Return what has arrived since the last call, in order."""
        with self._lock:
            arrivals = list(self._queue)
            self._queue.clear()
        return arrivals

    def health(self) -> Health:
        shown = self._shown()
        with self._lock:
            rate_hz = rate_of(self._recent, self._clock.monotonic_s())
            values = {"openings": self._connections, "unfetched samples": self._dropped, **shown}
            return Health(
                phase=self._phase,
                sentence=self._sentence,
                rate_hz=rate_hz if self._phase is Phase.RECEIVING else 0.0,
                counts=replace(self._counts),
                values=values,
            )

    def _shown(self) -> Mapping[str, object]:
        """What diagnostics show besides the link."""
        return {}

    # All that follows runs in the thread.

    def _run(self) -> None:
        while not self._stop.is_set():
            self._serve()
            self._clock.read()
            self._stop.wait(RETRY_S)

    def _serve(self) -> None:
        """Open the device and read it until the link is stopped, or the device has gone; never raises."""
        raise NotImplementedError

    def _admit(self, arrivals: list[Arrival], measured_s: list[float], sentence: str) -> None:
        """Queue arrivals; measured_s: the monotonic times of those that count for the rate."""
        with self._lock:
            for arrival in arrivals:
                self._dropped += len(self._queue) == QUEUE
                self._queue.append(arrival)
            self._recent.extend(measured_s)
        self._enter(Phase.RECEIVING, sentence)
        self._wake()

    def _enter(self, phase: Phase, sentence: str) -> None:
        with self._lock:
            changed = (phase, sentence) != (self._phase, self._sentence)
            self._phase, self._sentence = phase, sentence
        if changed:
            self._wake()

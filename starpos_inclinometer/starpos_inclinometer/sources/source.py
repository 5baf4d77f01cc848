# SPDX-License-Identifier: Apache-2.0
"""Interface between the node and a sensor. A new sensor is a TiltSource in a module here, and a line in `parameters`."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import Any, Protocol

from rclpy.node import Node

from starpos.messages.tilt import GAP, OUT_OF_RANGE, SATURATED, STUCK, TIME_UNKNOWN, Reading
from starpos_common.topics import Take
from starpos_inclinometer.clock import HostClock, Moment, Step

__all__ = [
    "GAP",
    "OUT_OF_RANGE",
    "SATURATED",
    "STUCK",
    "TIME_UNKNOWN",
    "Arrival",
    "Counts",
    "Health",
    "Phase",
    "Reading",
]

# for the sources


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


@dataclass(frozen=True, slots=True, kw_only=True)
class Counts:
    """Numbers of the lines, or of the messages of a topic, since the source was made."""

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
    # The device's identity when it sent this.
    identity: Any = None


@dataclass(frozen=True, slots=True, kw_only=True)
class TimedPulse:
    """An edge with its time, as it is published.

    input: of starpos_interfaces/Pulse.  sequence: counted on over resets.  bounces: edges since the one before that have
    no line.  stamp_ns: the host's time, or UTC by the receiver's second if `disciplined`.
    """

    input: int
    rising: bool
    sequence: int
    bounces: int
    device_time_s: float
    stamp_ns: int
    stddev_s: float
    disciplined: bool


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
    # The last step of the host's clock.
    step: Step | None = None
    values: Mapping[str, object] = field(default_factory=dict)


@dataclass(frozen=True)
class Surroundings:
    """What a node gives its source: itself, for topics; the host's clock; `wake`, which any thread may call.

    in_turn: makes a topic's callback, from its relative name and the function that takes its messages: in a replay each
    has its turn.
    replays: whether the node's time is simulated.
    """

    node: Node
    clock: HostClock
    wake: Callable[[], object]
    in_turn: Callable[[str, Take], Take] = lambda name, take: take
    replays: bool = False


class TiltSource(Protocol):
    """A source of tilts, made as SourceClass(host, values) from the node's parameters.

    Only the node's thread calls it.
    """

    # The port or topic of the device, for diagnostics.
    name: str

    def __init__(self, host: Surroundings, values: Mapping[str, Any]) -> None: ...

    @staticmethod
    def refusal(values: Mapping[str, Any]) -> str | None:
        """Say in a sentence why a source cannot be made of these parameters; None if it can."""

    @property
    def takes(self) -> Mapping[str, Take]:
        """Functions that take the messages of topics, by relative name."""
        return {}

    def start(self) -> None:
        """Begin to listen."""

    def stop(self) -> None:
        """End everything that `start` began; takes at most a second."""

    def restart(self) -> None:
        """Forget what came of topics: a replay begins."""
        return None

    def configure(self, values: Mapping[str, Any]) -> None:
        """Apply the parameters that may change at run time."""

    def take(self) -> list[Reading]:
        """Return the readings since the last call, in order."""

    def take_pulses(self) -> list[TimedPulse]:
        """Return the edges that the device has timed since the last call, in order; most devices time none."""
        return []

    def health(self) -> Health:
        """State of the source, for a person to read."""

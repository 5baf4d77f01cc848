# SPDX-License-Identifier: Apache-2.0
"""The results of a source: readings, and the state of the source."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import Any

from starpos.messages.tilt import GAP, OUT_OF_RANGE, SATURATED, STUCK, TIME_UNKNOWN, Reading
from starpos_inclinometer.host_clock import Moment, Step

# for the sources
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

# SPDX-License-Identifier: Apache-2.0
"""What sources give: readings, and how they stand."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import Any

from starpos_inclinometer.host_clock import Moment, Step

# starpos_interfaces/Tilt flags
OUT_OF_RANGE = 1
STUCK = 2
SATURATED = 4
GAP = 8


class Phase(Enum):
    """How a source stands."""

    ABSENT = "absent"  # the port cannot be opened, or it went; nobody publishes
    SILENT = "silent"  # open, but nothing comes
    GARBLED = "garbled"  # something comes, but no samples
    MOVING = "moving"  # what comes cannot tell the tilt, the instrument being on the move
    RECEIVING = "receiving"


@dataclass(frozen=True, slots=True, kw_only=True)
class Counts:
    """What has come in since the source was made; lines, or messages of a topic."""

    good: int = 0  # with the right checksum and form
    crc_errors: int = 0  # framed lines with the wrong checksum
    malformed: int = 0  # lines that are none of these, messages with NaN or without a time
    garbage_bytes: int = 0  # outside of lines
    lost: int = 0  # samples missing in the sequence
    duplicates: int = 0  # samples that came twice; dropped
    restarts: int = 0  # resets of the device
    implausible: int = 0  # samples that did not fit the others; dropped


@dataclass(frozen=True, slots=True)
class Arrival:
    """A sample of any kind, and when it was read."""

    sample: Any
    moment: Moment
    identity: Any = None  # what the device had said of itself when it sent this


@dataclass(frozen=True, slots=True, kw_only=True)
class Reading:
    """A tilt as it is published: ns of the host's time, rad (always finite), rad2 (xx, xy, yx, yy), deg C or NaN."""

    stamp_ns: int
    x: float
    y: float
    covariance: tuple[float, float, float, float]
    temperature_c: float
    sequence: int
    flags: int


@dataclass(frozen=True, kw_only=True)
class Health:
    """How a source stands, as a person wants to know it."""

    phase: Phase
    sentence: str
    rate_hz: float = 0.0  # of the samples, lately
    counts: Counts = field(default_factory=Counts)
    complaint: str = ""  # what is not as it should be though samples come
    step: Step | None = None  # of the host's clock, the last one
    values: Mapping[str, object] = field(default_factory=dict)

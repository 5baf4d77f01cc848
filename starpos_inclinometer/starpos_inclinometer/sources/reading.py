# SPDX-License-Identifier: Apache-2.0
"""The results of a source: readings, and the state of the source."""

import math
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
TIME_UNKNOWN = 16


class Phase(Enum):
    """State of a source."""

    ABSENT = "absent"  # the port cannot be opened, or it went away; nobody publishes
    SILENT = "silent"  # open, but nothing comes
    GARBLED = "garbled"  # bytes come, but no samples
    MOVING = "moving"  # samples come, but the instrument moves and they give no tilt
    RECEIVING = "receiving"


@dataclass(frozen=True, slots=True, kw_only=True)
class Counts:
    """Numbers of the lines, or of the messages of a topic, since the source was made."""

    good: int = 0  # with the right checksum and form
    crc_errors: int = 0  # framed lines with the wrong checksum
    malformed: int = 0  # lines of another form, messages with NaN or without a stamp
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
    identity: Any = None  # what the device had told about itself when it sent this


@dataclass(frozen=True, slots=True, kw_only=True)
class Reading:
    """A tilt as it is published.

    stamp_ns: the host's time.  x, y: rad, always finite.  covariance: rad2 (xx, xy, yx, yy).
    temperature_c: deg C, or NaN if it is not known.
    z, z_variance: rad, rad2; NaN of a two-axis sensor.
    """

    stamp_ns: int
    x: float
    y: float
    covariance: tuple[float, float, float, float]
    temperature_c: float
    sequence: int
    flags: int
    z: float = math.nan
    z_variance: float = math.nan


@dataclass(frozen=True, kw_only=True)
class Health:
    """State of a source, for a person to read."""

    phase: Phase
    sentence: str
    rate_hz: float = 0.0  # of the recent samples
    counts: Counts = field(default_factory=Counts)
    complaint: str = ""  # what is wrong although samples come
    step: Step | None = None  # the last step of the host's clock
    values: Mapping[str, object] = field(default_factory=dict)

# SPDX-License-Identifier: Apache-2.0
"""The time stamp of a message, and a header for a message made without middleware."""

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class PlainStamp:
    """Time as builtin_interfaces/Time has it."""

    sec: int
    nanosec: int

    @classmethod
    def of_ns(cls, unix_ns: int) -> "PlainStamp":
        """The stamp of a time in ns since 1970."""
        return cls(*divmod(unix_ns, 10**9))


@dataclass(frozen=True)
class PlainHeader:
    """Stamp and frame as std_msgs/Header has them."""

    stamp: PlainStamp
    frame_id: str


def stamp_to_ns(stamp: Any) -> int:
    """Nanoseconds since 1970 of a stamp, by which the messages of one frame are known."""
    return stamp.sec * 10**9 + stamp.nanosec


def stamp_to_unix(stamp: Any) -> float | None:
    """Unix seconds of a stamp, to the microsecond; None for 0, which means that the time is unknown."""
    if stamp.sec == 0 and stamp.nanosec == 0:
        return None
    return stamp.sec + stamp.nanosec * 1e-9

# SPDX-License-Identifier: Apache-2.0
"""The time stamp of a message."""

from typing import Any


def stamp_to_unix(stamp: Any) -> float | None:
    """Unix seconds of a stamp, to the microsecond; None for 0, which means that the time is unknown."""
    if stamp.sec == 0 and stamp.nanosec == 0:
        return None
    return stamp.sec + stamp.nanosec * 1e-9

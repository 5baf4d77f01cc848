# SPDX-License-Identifier: Apache-2.0
"""The middle of an exposure from what a camera tells of it."""

import math
import re
from collections.abc import Mapping
from datetime import datetime, timezone

DRIVER_STDDEV_S = 0.005  # a driver reads its clock, then tells the camera, or the other way round


def middle_of_commanded(commanded_s: float, exposure_s: float, values: Mapping) -> tuple[float, float]:
    """Unix time of the middle and its standard deviation (s), of an exposure known only by when it was asked for."""
    return commanded_s + values["command_lag"] + exposure_s / 2, values["command_lag_stddev"]


def middle_of_started(start_s: float, resolution_s: float, exposure_s: float) -> tuple[float, float]:
    """The same of an exposure whose start the driver tells, rounded to or cut off at a resolution: nobody says which."""
    stddev_s = max(DRIVER_STDDEV_S, 1.5 * resolution_s / math.sqrt(12))
    return start_s + resolution_s / 4 + exposure_s / 2, stddev_s


def read_utc(text: str) -> tuple[float, float] | None:
    """Unix time of a time in ISO 8601 and UTC, and its last digit's resolution (s); None: it is no such time."""
    match = re.fullmatch(
        r"(\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d)(?:\.(\d+))?(?:Z|\+00:00)?", text.strip(), re.ASCII
    )
    if not match:
        return None
    decimals = match[2] or ""
    try:
        whole = datetime.fromisoformat(match[1]).replace(tzinfo=timezone.utc).timestamp()
    except ValueError:
        return None
    return whole + float(f"0.{decimals or 0}"), 10.0 ** -len(decimals)

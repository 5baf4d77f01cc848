# SPDX-License-Identifier: Apache-2.0
"""The middle of an exposure from what a camera tells of it."""

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from datetime import datetime, timezone

from starpos_common.parameters import Parameter
from starpos_interfaces.msg import Capture

LOCAL = ("127.0.0.1", "localhost", "::1")  # hosts whose clock is this machine's
CLOCK_TOLERANCE_S = 0.05  # between what a driver says of its exposure and when it was commanded and had


def server_clock(source: str) -> Parameter:
    """`SOURCE.clock_stddev` of a source whose camera is behind a server."""
    return Parameter(
        f"{source}.clock_stddev",
        math.nan,
        "How well the clock of the server's machine is kept to UTC, where it is another one than this. Unset: its times "
        "are not used, but those of the commands, on this machine's clock. Too small a value claims a wrong longitude.",
        unit="s",
        minimum=1e-9,  # 0 says that it is this machine's
        maximum=60.0,
    )


def clock_stddev_of(source: str, host: str, values: Mapping) -> float:
    """What `stamp_of` wants to know of the clock of a server on that host."""
    return 0.0 if host in LOCAL else values[f"{source}.clock_stddev"]


@dataclass(frozen=True)
class Stamp:
    """When an exposure had its middle (Unix time), and how that is known.

    stddev_s        standard deviation of mid_s
    source          one of starpos_interfaces/Capture's constants
    clock_stddev_s  standard deviation against UTC of a clock that is not this machine's; 0: it is
    remark          what is wrong with the driver's clock, without a full stop; '' for nothing
    """

    mid_s: float
    stddev_s: float
    source: int
    clock_stddev_s: float = 0.0
    remark: str = ""


def stamp_of(
    told: str, clock_stddev_s: float, exposure_s: float, commanded_s: float, ready_s: float, values: Mapping
) -> Stamp:
    """The best of what a driver tells of an exposure's start, in ISO 8601, and of when it was commanded.

    clock_stddev_s: of the driver's clock; 0: it is this machine's, NaN: unknown, so that it is not used. Nor is what
    cannot be, as an exposure lies between commanded_s and ready_s (Unix time).
    """
    commanded = Stamp(*middle_of_commanded(commanded_s, exposure_s, values), Capture.COMMAND)
    start = read_utc(told)
    if start is None or math.isnan(clock_stddev_s):
        return commanded
    start_s, resolution_s = start
    if start_s % 1 == 0:  # some drivers count whole seconds, and write .000
        resolution_s = 1.0
    tolerance_s = CLOCK_TOLERANCE_S + resolution_s + 3 * clock_stddev_s
    if max(commanded_s - start_s, start_s + exposure_s - ready_s) > tolerance_s:
        off = f"its times of exposures are off by more than {tolerance_s:.2g} s and not used"
        return replace(commanded, remark=f"{off}; set its machine's clock, to UTC")
    mid_s, stddev_s = middle_of_started(start_s, resolution_s, exposure_s, values)
    if math.hypot(stddev_s, clock_stddev_s) > commanded.stddev_s:
        return commanded
    return Stamp(mid_s, stddev_s, Capture.DRIVER, clock_stddev_s)


def middle_of_commanded(commanded_s: float, exposure_s: float, values: Mapping) -> tuple[float, float]:
    """Unix time of the middle and its standard deviation (s), of an exposure known only by when it was asked for."""
    return commanded_s + values["command_lag"] + exposure_s / 2, values["command_lag_stddev"]


def middle_of_started(
    start_s: float, resolution_s: float, exposure_s: float, values: Mapping
) -> tuple[float, float]:
    """The same of an exposure whose start the driver tells, rounded to or cut off at a resolution: nobody says which."""
    stddev_s = math.hypot(values["driver_lag_stddev"], 1.5 * resolution_s / math.sqrt(12))
    return start_s + values["driver_lag"] + resolution_s / 4 + exposure_s / 2, stddev_s


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

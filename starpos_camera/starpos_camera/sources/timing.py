# SPDX-License-Identifier: Apache-2.0
"""Middle of an exposure, from the times that a camera reports."""

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from datetime import datetime, timezone

from starpos_common.parameters import Parameter
from starpos_interfaces.msg import Capture

# Hosts whose clock is this machine's.
LOCAL = ("127.0.0.1", "localhost", "::1")
# Tolerance between a driver's times of an exposure and the times of command and arrival.
CLOCK_TOLERANCE_S = 0.05


def server_clock(source: str) -> Parameter:
    """Make the parameter `SOURCE.clock_stddev` for a source whose camera is behind a server."""
    return Parameter(
        f"{source}.clock_stddev",
        math.nan,
        "Error of the clock of the server's machine against UTC, 1 sigma, if the server runs on "
        "another machine. Unset uses the times of the commands by this machine's clock instead of "
        "the server's. If too small, fixes claim errors of longitude that are too small.",
        unit="s",
        # 0 would mean this machine's clock.
        minimum=1e-9,
        maximum=60.0,
    )


def clock_stddev_of(source: str, host: str, values: Mapping) -> float:
    """Error of the clock of a server on that host, as `stamp_of` takes it."""
    return 0.0 if host in LOCAL else values[f"{source}.clock_stddev"]


@dataclass(frozen=True)
class Stamp:
    """Middle of an exposure (Unix time), and how it is known.

    stddev_s        standard deviation of mid_s
    source          one of starpos_interfaces/Capture's constants
    clock_stddev_s  standard deviation against UTC of another machine's clock; 0: the clock is this machine's
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
    """Choose the better stamp: from the start that the driver reports (`told`, ISO 8601), or from the command.

    clock_stddev_s: of the driver's clock; 0: it is this machine's clock; NaN: unknown, and the start is not used.
    commanded_s, ready_s: Unix times between which the exposure lies; a start that contradicts them is not used.
    """
    commanded = Stamp(*middle_of_commanded(commanded_s, exposure_s, values), Capture.COMMAND)
    start = read_utc(told)
    if start is None or math.isnan(clock_stddev_s):
        return commanded
    start_s, resolution_s = start
    # Some drivers count whole seconds but write .000.
    if start_s % 1 == 0:
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
    """Middle (Unix time) and its standard deviation (s) from the time of the command alone."""
    return commanded_s + values["command_lag"] + exposure_s / 2, values["command_lag_stddev"]


def middle_of_started(
    start_s: float, resolution_s: float, exposure_s: float, values: Mapping
) -> tuple[float, float]:
    """Middle and its standard deviation from the start that the driver reports, rounded or cut at its resolution."""
    stddev_s = math.hypot(values["driver_lag_stddev"], 1.5 * resolution_s / math.sqrt(12))
    return start_s + values["driver_lag"] + resolution_s / 4 + exposure_s / 2, stddev_s


def read_utc(text: str) -> tuple[float, float] | None:
    """Read a UTC time in ISO 8601; return Unix time and the resolution of its last digit (s); None if invalid."""
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

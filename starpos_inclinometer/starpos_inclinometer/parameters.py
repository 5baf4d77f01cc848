# SPDX-License-Identifier: Apache-2.0
"""The sources by their name in the parameter `source`, and the parameters of the node `inclinometer`.

A new sensor needs a module in `sources` and a line below.
"""

from collections.abc import Mapping
from typing import Any

from starpos.session.inclinometer_parameters import SHARED
from starpos_common.parameters import Parameter
from starpos_inclinometer.sources.ascii_line import AsciiSource
from starpos_inclinometer.sources.iio import IioSource
from starpos_inclinometer.sources.imu import ImuSource
from starpos_inclinometer.sources.mcu import McuSource
from starpos_inclinometer.sources.source import TiltSource

SOURCES: dict[str, type[TiltSource]] = {
    "serial": McuSource,
    "imu": ImuSource,
    "ascii": AsciiSource,
    "iio": IioSource,
}


COMMON = (
    Parameter(
        "source",
        "serial",
        "Where tilts come from: starpos's board (serial), an IMU on imu/data (imu), a tiltmeter that sends text "
        "(ascii), a sensor behind Linux's driver (iio).",
        choices=tuple(SOURCES),
        read_only=True,
    ),
    *SHARED,
)
# Two sources may share a parameter, as the two on a serial port do.
PARAMETERS = tuple(
    {p.name: p for p in (*COMMON, *(p for s in SOURCES.values() for p in s.parameters))}.values()
)


def refusal(values: Mapping[str, Any]) -> str | None:
    """Say in a sentence why the chosen source cannot be made of these values; None if it can."""
    return SOURCES[values["source"]].refusal(values)

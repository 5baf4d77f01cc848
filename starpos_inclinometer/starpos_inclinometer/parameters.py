# SPDX-License-Identifier: Apache-2.0
"""Parameters of the node `inclinometer`; a source's own are in its module."""

from collections.abc import Mapping
from typing import Any

from starpos.session.inclinometer_parameters import SHARED
from starpos_common.parameters import Parameter
from starpos_inclinometer.sources.registry import SOURCES

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

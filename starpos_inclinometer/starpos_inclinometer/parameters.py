# SPDX-License-Identifier: Apache-2.0
"""Parameters of the node `inclinometer`; those of a source are in the module of the source."""

import math
from collections.abc import Mapping
from typing import Any

from starpos_common.parameters import FRAME_NAME, Parameter
from starpos_inclinometer.sources.registry import SOURCES

COMMON = (
    Parameter(
        "source",
        "serial",
        "Where tilts come from: serial is the starpos microcontroller, imu a sensor_msgs/Imu on imu/data, ascii lines "
        "of text from a digital tiltmeter, iio a sensor that Linux's own driver reads (Industrial I/O).",
        choices=tuple(SOURCES),
        read_only=True,
    ),
    Parameter(
        "frame_id",
        "starpos_inclinometer_frame",
        "Frame of the tilts: S, the sensor's X', Y', Z'; of source imu, the IMU's own axes.",
        read_only=True,
        form=FRAME_NAME,
    ),
    Parameter(
        "noise_stddev",
        math.nan,
        "White noise of one sample and axis, at least; unset takes what the samples show, 0.0035 deg until there are "
        "enough. Too large widens fixes for nothing.",
        unit="deg",
        minimum=1e-6,
        maximum=10.0,
    ),
    Parameter(
        "latency",
        math.nan,
        "From the middle of a sample to the first byte of its line, of source imu to its stamp; unset takes what the "
        "microcontroller reports, 0 of other sources. Matters only while the tilt moves.",
        unit="s",
        minimum=0.0,
        maximum=10.0,
    ),
)
# Two sources may share a parameter, as the two on a serial port do.
PARAMETERS = tuple(
    {p.name: p for p in (*COMMON, *(p for s in SOURCES.values() for p in s.parameters))}.values()
)


def refusal(values: Mapping[str, Any]) -> str | None:
    """Say in a sentence why the chosen source cannot be made of these values; None if it can."""
    return SOURCES[values["source"]].refusal(values)

# SPDX-License-Identifier: Apache-2.0
"""The sources by their name in the parameter `source`. A new sensor needs a module in this folder and a line below."""

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

# SPDX-License-Identifier: Apache-2.0
"""The sources by the name that the parameter `source` gives them; a new sensor is a module here and a line below."""

from starpos_inclinometer.sources.ascii_line import AsciiSource
from starpos_inclinometer.sources.imu import ImuSource
from starpos_inclinometer.sources.mcu import McuSource
from starpos_inclinometer.sources.source import TiltSource

SOURCES: dict[str, type[TiltSource]] = {
    "serial": McuSource,
    "imu": ImuSource,
    "ascii": AsciiSource,
}

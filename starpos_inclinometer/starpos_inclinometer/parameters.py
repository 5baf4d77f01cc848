# SPDX-License-Identifier: Apache-2.0
"""The parameters of the node `inclinometer`, and what they mean for the sensor."""

import math
from collections.abc import Mapping
from typing import Any

from starpos_common.parameters import FRAME_NAME, Parameter
from starpos_inclinometer.sources import mcu_protocol, sca100t
from starpos_inclinometer.sources.ascii_line import UNITS, pattern_error

SOURCES = ("serial", "imu", "ascii")
NUMBER = r"[-+]?\d+\.?\d*"
SMALLEST_DETERMINANT = 0.5  # of the cross-axis matrix: less, and the axes are no two axes
MAX_REQUEST = 256

PARAMETERS = (
    Parameter(
        "source",
        "serial",
        "Where tilts come from: serial is the starpos microcontroller, imu a sensor_msgs/Imu on imu/data, ascii lines "
        "of text from a digital tiltmeter.",
        choices=SOURCES,
        read_only=True,
    ),
    Parameter(
        "port",
        "/dev/ttyUSB0",
        "Serial port; a stable path such as /dev/serial/by-id/... survives replugging, /dev/ttyUSB0 may "
        "become another device.",
        read_only=True,
    ),
    Parameter(
        "baud",
        mcu_protocol.BAUD,
        "Speed of the serial line; with a wrong one nothing but garbage comes.",
        unit="baud",
        minimum=1200,
        maximum=1_000_000,
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
        "rate",
        10,
        "Samples a second from the microcontroller; above 18 Hz, the sensor's bandwidth, they add little.",
        unit="Hz",
        minimum=mcu_protocol.MIN_RATE_HZ,
        maximum=mcu_protocol.MAX_RATE_HZ,
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
        "offset_volts",
        (2.5, 2.5),
        "Sensor output of x and y at zero tilt; an error of 1 mV is 52 arcsec of tilt, 1.6 km of position.",
        unit="V",
        minimum=0.0,
        maximum=5.5,
    ),
    Parameter(
        "sensitivity",
        (4.0, 4.0),
        "Sensor sensitivity of x and y, 4 for the SCA100T-D01; 0.1 % off is 36 arcsec at 10 deg of tilt.",
        unit="V/g",
        minimum=0.1,
        maximum=100.0,
    ),
    Parameter(
        "divider",
        sca100t.DIVIDER,
        "Divider between sensor and ADC, (R1 + R2) / R2; 0.1 % off is 36 arcsec at 10 deg of tilt.",
        unit="",
        minimum=1.0,
        maximum=1000.0,
    ),
    Parameter(
        "reference_volts",
        sca100t.ADC_NOMINAL_REFERENCE_V,
        "Reference of the ADC and supply of the sensor that offset_volts and sensitivity were measured at; "
        "the circuit is ratiometric, so what it is at work does not matter.",
        unit="V",
        minimum=4.5,
        maximum=5.5,
    ),
    Parameter(
        "cross_axis",
        (1.0, 0.0, 0.0, 1.0),
        "Matrix (xx, xy, yx, yy) that takes what the sensor's two axes feel, in g, into X' and Y' of S; 0.01 off in xy "
        "is 0.6 deg of x at 90 deg of y, 360 arcsec at 10 deg.",
        unit="",
        minimum=-2.0,
        maximum=2.0,
    ),
    Parameter(
        "temperature.reference",
        25.0,
        "Temperature that offset_volts and sensitivity hold at; the four polynomials below are in T less this.",
        unit="deg C",
        minimum=-40.0,
        maximum=125.0,
    ),
    *(
        Parameter(
            f"temperature.offset_{axis}",
            (0.0, 0.0, 0.0),
            f"What is added to the offset of {axis}: linear, square and cubic term; 0.5 mV/deg C left out is 26 arcsec "
            "a degree. All zeros: no compensation.",
            unit="V/deg C^n",
            minimum=-0.1,
            maximum=0.1,
        )
        for axis in "xy"
    ),
    *(
        Parameter(
            f"temperature.sensitivity_{axis}",
            (0.0, 0.0, 0.0),
            f"Share by which the sensitivity of {axis} grows: linear, square and cubic term; 0.0001/deg C left out is "
            "3.6 arcsec a degree at 10 deg of tilt.",
            unit="1/deg C^n",
            minimum=-0.01,
            maximum=0.01,
        )
        for axis in "xy"
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
    Parameter(
        "imu.average",
        0.5,
        "Time over which an IMU's accelerations are averaged to one tilt; short ones are noisy, long ones late.",
        unit="s",
        minimum=0.02,
        maximum=60.0,
    ),
    Parameter(
        "imu.max_force_error",
        0.05,
        "Share by which the IMU's acceleration may differ from 9.81 m/s2; beyond it is not at rest and tells no tilt. "
        "Too small refuses an uncalibrated accelerometer, too large takes driving for leaning.",
        unit="",
        minimum=0.0001,
        maximum=0.5,
    ),
    Parameter(
        "imu.max_rotation",
        2.0,
        "Rate of rotation beyond which the IMU is not at rest, its gyroscope's own offset included.",
        unit="deg/s",
        minimum=0.001,
        maximum=360.0,
    ),
    Parameter(
        "ascii.pattern",
        rf"(?P<x>{NUMBER})[,;\s]+(?P<y>{NUMBER})",
        "Regular expression (Python's) that a whole line must match, with the named groups x, y, and where the device "
        "tells them temperature [deg C], sequence, milliseconds or seconds (of its own clock).",
        read_only=True,
    ),
    Parameter(
        "ascii.unit",
        "deg",
        "Unit of x and y; g, mg and percent_g are the sine of the tilt. A wrong one is wrong by its factor.",
        choices=UNITS,
        read_only=True,
    ),
    Parameter(
        "ascii.resolution",
        math.nan,
        "Step of x and y in ascii.unit; unset takes the last digit a line shows.",
        unit="",
        minimum=0.0,
        maximum=1e6,
        read_only=True,
    ),
    Parameter(
        "ascii.period",
        0.1,
        "From line to line, or from request to request; the device counts as silent after 1.5 of them, at least 1 s.",
        unit="s",
        minimum=0.02,
        maximum=60.0,
        read_only=True,
    ),
    Parameter(
        "ascii.request",
        "",
        "What to send once a period, for a device that speaks when it is asked, with its line end; empty: nothing.",
        read_only=True,
    ),
    Parameter(
        "ascii.stuck_samples",
        100,
        "So many equal lines in a row are a stuck device; 0: never, for one whose steps are coarser than its noise.",
        unit="",
        minimum=0,
        maximum=1_000_000,
    ),
)


def complaint(values: Mapping[str, Any]) -> str | None:
    """Why these values do not fit together, in one sentence; None where they do."""
    xx, xy, yx, yy = values["cross_axis"]
    if abs(xx * yy - xy * yx) < SMALLEST_DETERMINANT:
        return (
            "parameter cross_axis must be two different axes (xx, xy, yx, yy), such as [1, 0, 0, 1]; "
            f"{list(values['cross_axis'])} was given."
        )
    if values["source"] != "imu" and not values["port"].strip():
        return "parameter port must name the serial port, such as /dev/serial/by-id/...; it is empty."
    if values["source"] != "ascii":
        return None
    if not values["ascii.request"].isascii() or len(values["ascii.request"]) > MAX_REQUEST:
        return f"ascii.request must be at most {MAX_REQUEST} ASCII characters."
    return pattern_error(values["ascii.pattern"])


def calibration(values: Mapping[str, Any]) -> sca100t.Sca100tCalibration:
    """The sensor's calibration that the parameters say."""
    floor = values["noise_stddev"]
    return sca100t.Sca100tCalibration(
        offset_volts=values["offset_volts"],
        sensitivity_volts_per_g=values["sensitivity"],
        divider=values["divider"],
        reference_volts=values["reference_volts"],
        cross_axis=values["cross_axis"],
        temperature_reference_c=values["temperature.reference"],
        offset_per_c=(values["temperature.offset_x"], values["temperature.offset_y"]),
        sensitivity_per_c=(values["temperature.sensitivity_x"], values["temperature.sensitivity_y"]),
        noise_floor_rad=0.0 if math.isnan(floor) else math.radians(floor),
    )

# SPDX-License-Identifier: Apache-2.0
"""What the instrument says, for the dashboard: messages as the nodes send them, with the numbers a test wants."""

import array
import math

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from sensor_msgs.msg import Image, Imu, NavSatFix, NavSatStatus

from starpos_interfaces.msg import ErrorTerm, GnssCheck, Solution, Tilt

NAN = math.nan


def fix(
    latitude=48.1373, longitude=11.5755, covariance=(300.0**2, 9000.0, 100.0**2), stamp=None
) -> NavSatFix:
    """covariance: ee, en, nn [m2]; a latitude of nan is no fix."""
    ee, en, nn = covariance
    message = NavSatFix(latitude=latitude, longitude=longitude, altitude=NAN)
    message.position_covariance = [ee, en, 0.0, en, nn, 0.0, 0.0, 0.0, 1e8]
    message.position_covariance_type = NavSatFix.COVARIANCE_TYPE_KNOWN
    if math.isnan(latitude):
        message.status.status = NavSatStatus.STATUS_NO_FIX
        message.longitude = NAN
        message.position_covariance = [0.0] * 9
        message.position_covariance_type = NavSatFix.COVARIANCE_TYPE_UNKNOWN
    return message


def imu(azimuth_deg=217.25, sigma_deg=0.004) -> Imu:
    """Level, its x axis towards an azimuth."""
    half = math.radians(90.0 - azimuth_deg) / 2
    message = Imu()
    message.header.frame_id = "starpos_link"
    message.orientation.z, message.orientation.w = math.sin(half), math.cos(half)
    message.orientation_covariance[[0, 4, 8]] = math.radians(sigma_deg) ** 2
    return message


def tilt(x_deg=12.0, y_deg=-6.0, sigma_deg=0.0035, flags=0) -> Tilt:
    variance = math.radians(sigma_deg) ** 2
    return Tilt(
        x=math.radians(x_deg),
        y=math.radians(y_deg),
        covariance=[variance, 0.0, 0.0, variance],
        temperature=11.3,
        flags=flags,
    )


def solution(status=Solution.OK, sentence="21 stars fit", warnings=()) -> Solution:
    good = status == Solution.OK
    message = Solution(
        status=status,
        status_text=sentence,
        stars_detected=41,
        stars_matched=21 if good else 0,
        warnings=warnings,
    )
    message.residual = 0.83 if good else NAN
    if good:
        message.budget = [
            ErrorTerm(name="centroids", east=3.0, north=4.0, heading=0.001),
            ErrorTerm(name="deflection", east=120.0, north=160.0, heading=0.002, common=True),
        ]
    return message


def gnss(status=GnssCheck.DISAGREES, latitude=48.1553, longitude=11.5755) -> GnssCheck:
    """The solver's message about GNSS 2 km north of `fix`."""
    sentence = "GNSS is 2 km north of where the stars put us (120 m): it is not believed"
    return GnssCheck(status=status, status_text=sentence, latitude=latitude, longitude=longitude)


def diagnostics(*statuses) -> DiagnosticArray:
    """statuses: (name, level, sentence)."""
    return DiagnosticArray(
        status=[DiagnosticStatus(name=n, level=bytes([lv]), message=m) for n, lv, m in statuses]
    )


def image(width=1600, height=1000, encoding="bgr8", left=(200, 0, 0), right=(0, 200, 0)) -> Image:
    """Two colours (blue, green, red): of the left half and of the right."""
    pixels = np.empty((height, width, 3), np.uint8)
    pixels[:, : width // 2], pixels[:, width // 2 :] = left, right
    message = Image(width=width, height=height, encoding=encoding, step=3 * width)
    message.data = array.array("B", pixels.tobytes())
    return message

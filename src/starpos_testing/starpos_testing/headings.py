# SPDX-License-Identifier: Apache-2.0
"""The heading in an attitude's message."""

import math


def yaw_deg(imu) -> float:
    """The yaw of an Imu message, in deg from east, counted counterclockwise (REP-103)."""
    q = imu.orientation
    return math.degrees(math.atan2(2 * (q.w * q.z + q.x * q.y), 1 - 2 * (q.y * q.y + q.z * q.z)))

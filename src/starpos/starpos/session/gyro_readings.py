# SPDX-License-Identifier: Apache-2.0
"""A gyro's readings of the last minute: how the body has turned."""

from dataclasses import replace
from typing import Any

import numpy as np

from starpos.errors import VoyageError
from starpos.messages.stamp import stamp_to_unix
from starpos.navigation.preintegration import turn_between
from starpos.navigation.recent import BACK_S, RecentReadings
from starpos.navigation.records import clipped

# time for which readings are kept, and length of a block
KEPT_S, BLOCK_S = 60.0, 1.0
# rad/s; every gyro measures up to this, so values repeated below it are not clipping
MIN_RANGE = 1.0
NO_RATES = np.zeros((0, 3))


class GyroReadings:
    """Takes sensor_msgs/Imu of which only the turn rates count, rad/s along the IMU's axes."""

    def __init__(self) -> None:
        self._recent = RecentReadings()
        self._block_s = -np.inf

    def receive(self, message: Any) -> None:
        """Keep a reading; VoyageError in a sentence if it cannot be used."""
        w, time_s = message.angular_velocity, stamp_to_unix(message.header.stamp)
        if message.angular_velocity_covariance[0] == -1:
            raise VoyageError(
                "the IMU says by a covariance of -1 that it measures no rates: use one that does"
            )
        if time_s is None:
            raise VoyageError(
                "an inertial reading has no time stamp: set header.stamp to when it was measured"
            )
        if time_s < self._recent.last_s - BACK_S:
            # its clock was set
            self._recent = RecentReadings()
        self._recent.append((time_s, w.x, w.y, w.z, 0.0, 0.0, 0.0))
        if not 0 <= time_s - self._block_s < BLOCK_S:
            self._block_s = time_s
            self._recent.close()
            self._recent.forget(time_s - KEPT_S)

    def turn(
        self, begin_s: float, end_s: float, most_missing_s: float, bias: np.ndarray
    ) -> np.ndarray | None:
        """The body's axes (3, 3) at a time in those at an earlier one, with a bias (3,) in rad/s taken off.

        None where more than most_missing_s of it are without readings, or where readings look clipped.
        """
        recent = self._recent
        if not (np.isfinite(recent.last_s) and recent.last_s - KEPT_S < begin_s < end_s):
            return None
        recent.close()
        # beyond the newest reading its rate is extrapolated
        imu = recent.since(min(begin_s, recent.last_s - 1e-6))
        rows = (block[block[:, 0] > begin_s, 1:4] for block in recent.blocks() if block[-1, 0] > begin_s)
        rates = np.concatenate([NO_RATES, *rows])
        if len(rates) and (np.abs(rates[clipped(rates)]) > MIN_RANGE).any():
            return None
        turn, missing_s = turn_between(replace(imu, gyro=imu.gyro - bias), begin_s, end_s)
        return turn if missing_s <= most_missing_s else None

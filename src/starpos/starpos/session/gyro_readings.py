# SPDX-License-Identifier: Apache-2.0
"""A gyro's readings of the last minute, and the trails that the body's turn gives the stars of a frame."""

from dataclasses import replace
from typing import Any

import numpy as np

from starpos.errors import VoyageError
from starpos.frames.exposure import Trail
from starpos.frames.frame import Frame
from starpos.instrument.instrument import TOP_OF_FRAME
from starpos.messages.camera import message_to_camera
from starpos.messages.stamp import stamp_to_unix
from starpos.navigation.preintegration import turn_between
from starpos.navigation.recent import BACK_S, RecentReadings
from starpos.navigation.records import clipped
from starpos.session.settings import known_instrument

# time for which readings are kept, and length of a block
KEPT_S, BLOCK_S = 60.0, 1.0
# rad/s; every gyro measures up to this, so values repeated below it are not clipping
MIN_RANGE = 1.0
NO_RATES = np.zeros((0, 3))
# this share of an exposure may be without readings
MAX_MISSING = 0.1
# cosine of the largest turn in an exposure: 60 deg
MIN_COSINE = 0.5


class Trails:
    """Takes a gyro's readings and the camera's intrinsics, and gives frames their trails.

    calibration_url: instrument file whose link_to_camera takes the IMU's axes into C, '' for the usual ones;
    InstrumentError if it is broken.
    """

    def __init__(self, calibration_url: str) -> None:
        # it needs scipy's rotations, which a detector without a gyro does not load
        known = known_instrument(calibration_url)
        self._link = np.asarray(known.link_to_camera if known else TOP_OF_FRAME, float)
        self._recent = RecentReadings()
        self._block_s = -np.inf
        self._focal_px: float | None = None

    def receive_imu(self, message: Any) -> None:
        """Keep the turn rates of a sensor_msgs/Imu, rad/s; VoyageError in a sentence if it cannot be used."""
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

    def receive_camera(self, message: Any) -> None:
        """Take a CameraInfo; InstrumentError in a sentence if it cannot be used."""
        # a size that it leaves open does not matter here
        self._focal_px = message_to_camera(message, size=(1, 1)).fx

    def with_trail(self, frame: Frame) -> Frame:
        """The frame with its trail; as it is where time, exposure, focal length or readings lack, or it turned far."""
        if self._focal_px is None or frame.mid_unix_s is None or not frame.exposure_s:
            return frame
        begin_s, end_s = (frame.mid_unix_s + share * frame.exposure_s for share in (-0.5, 0.5))
        turn = self._turn(begin_s, end_s)
        if turn is None:
            return frame
        # of directions at the beginning into those at the end; its last column is where a star on the axis goes
        moved = self._link @ turn.T @ self._link.T
        x, y = self._focal_px * moved[:2, 2] / max(moved[2, 2], MIN_COSINE)
        # turned so far that stars cross the frame: their trail cannot be determined
        if np.trace(moved) < 1 + 2 * MIN_COSINE or np.hypot(x, y) > frame.width + frame.height:
            return frame
        roll_rad = np.arctan2(moved[1, 0] - moved[0, 1], moved[0, 0] + moved[1, 1])
        return replace(frame, trail=Trail(middle_px=(float(x), float(y)), roll_rad=float(roll_rad)))

    def _turn(self, begin_s: float, end_s: float) -> np.ndarray | None:
        """The body's axes (3, 3) at the end of an exposure in those at its beginning.

        None where more than MAX_MISSING of it is without readings, or where readings look clipped.
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
        turn, missing_s = turn_between(imu, begin_s, end_s)
        return turn if missing_s <= MAX_MISSING * (end_s - begin_s) else None

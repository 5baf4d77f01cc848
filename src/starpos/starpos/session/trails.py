# SPDX-License-Identifier: Apache-2.0
"""How far a gyro says that the stars of a frame have moved during its exposure."""

from dataclasses import replace
from typing import Any

import numpy as np

from starpos.frames.frame import Frame
from starpos.frames.trail import Trail
from starpos.instrument.instrument import TOP_OF_FRAME
from starpos.messages.camera import message_to_camera
from starpos.session.parameters import known_instrument

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
        from starpos.session.gyro_readings import GyroReadings

        known = known_instrument(calibration_url)
        self._link = np.asarray(known.link_to_camera if known else TOP_OF_FRAME, float)
        self._readings = GyroReadings()
        self._focal_px: float | None = None

    def take_imu(self, message: Any) -> None:
        """Take a sensor_msgs/Imu; VoyageError in a sentence if it cannot be used."""
        self._readings.take(message)

    def take_camera(self, message: Any) -> None:
        """Take a CameraInfo; InstrumentError in a sentence if it cannot be used."""
        # a size that it leaves open does not matter here
        self._focal_px = message_to_camera(message, size=(1, 1)).fx

    def told(self, frame: Frame) -> Frame:
        """The frame with its trail; as it is where time, exposure, focal length or readings lack, or it turned far."""
        if self._focal_px is None or frame.mid_unix_s is None or not frame.exposure_s:
            return frame
        begin_s, end_s = (frame.mid_unix_s + share * frame.exposure_s for share in (-0.5, 0.5))
        turn = self._readings.turn(begin_s, end_s, MAX_MISSING * frame.exposure_s, np.zeros(3))
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

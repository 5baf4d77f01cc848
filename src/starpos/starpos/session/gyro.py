# SPDX-License-Identifier: Apache-2.0
"""Where a camera looks, by the last attitude from its stars and the gyro's turn since.

It is a prior: the stars decide, so an error here costs half a millisecond a frame and no answer.
"""

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from starpos import rotation
from starpos.errors import VoyageError
from starpos.fix.solver import Solver
from starpos.frames.frame import Stars
from starpos.identification import Identification, PointingPrior
from starpos.navigation.records import ImuModel
from starpos.session.driver import Driver, Now

if TYPE_CHECKING:
    from starpos.session.gyro_readings import GyroReadings

IMU_TOPIC = "imu/data"
# a frame does not wait for readings: longest time for which the last rate is extrapolated, and total of gaps
MAX_MISSING_S = 0.1
# worst case, 1 sigma an axis: a cheap IMU, its mounting on the camera, and an attitude by few stars about the axis
WORST, MOUNT_RAD, STARS_RAD = ImuModel(), math.radians(1.0), 1e-3
# rad/s; lower bound of the bias's sigma
MIN_BIAS_STDDEV = 1e-3
# a gyro off by more sigma measures in another unit, or along other axes
CONTRADICTION = 6.0


class Gyro:
    """Takes a gyro's readings and a camera's attitudes, and predicts the next one.

    The prediction's error grows with time by the gyro's noise and bias, and with the turn by its scale and mount.  Each
    pair of attitudes improves the bias.
    """

    def __init__(self, driver: Driver) -> None:
        self._driver = driver
        self._readings: GyroReadings | None = None
        self.forget()

    def forget(self) -> None:
        """Forget the attitude and what is known of the bias, as where the camera is another one."""
        self._seen_s = math.nan
        self._seen: PointingPrior | None = None
        self._forget_bias()

    def _forget_bias(self) -> None:
        self._bias: np.ndarray = np.zeros(3)
        self._bias_stddev = WORST.gyroscope_bias_stddev

    def receive(self, message: Any, now: Now) -> None:
        """Keep a live sensor_msgs/Imu. Answers to recorded data must not depend on what was read before a frame."""
        if now.played:
            return
        if self._readings is None:
            # it needs scipy, which a solver without a gyro does not load
            from starpos.session.gyro_readings import GyroReadings

            self._readings = GyroReadings()
        try:
            self._readings.receive(message)
            self._driver.came(IMU_TOPIC)
        except VoyageError as e:
            self._driver.refuse(IMU_TOPIC, str(e))

    def predicted(self, stars: Stars, solver: Solver | None) -> tuple[PointingPrior, ...]:
        """The attitude of a frame whose stars are to be identified; () where it would be of no use."""
        mid_s = stars.mid_unix_s
        if solver is None or mid_s is None or (turned := self._turned(mid_s, solver)) is None:
            return ()
        prior, error = turned
        return (prior,) if error < prior.reach_rad(stars.width, stars.height) else ()

    def learn_from(self, stars: Stars, found: Identification, solver: Solver) -> None:
        """Take an attitude from stars identified beyond doubt, and learn the bias from it."""
        mid_s, (camera, _, _) = stars.mid_unix_s, solver.view(stars.width, stars.height)
        if mid_s is None:
            return
        seen = PointingPrior(found.attitude, camera.fx * found.focal_scale)
        if (turned := self._turned(mid_s, solver)) is not None:
            prior, error = turned
            off = rotation.to_vector(seen.attitude @ prior.attitude.T)
            self._learn(_link(solver).T @ off, math.hypot(error, STARS_RAD), mid_s - self._seen_s)
        self._seen, self._seen_s = seen, mid_s

    def _learn(self, off: np.ndarray, error: float, since_s: float) -> None:
        """Learn the bias from the gyro's error (3,), rad along its axes, after a time, and the sigma of this error."""
        if np.linalg.norm(off) > CONTRADICTION * error:
            degrees = math.degrees(np.linalg.norm(off))
            self._driver.refuse(
                IMU_TOPIC,
                f"the gyro is {degrees:.3g} deg off the stars after {since_s:.3g} s: give rad/s along the axes that "
                "calibration_url's link_to_camera turns into the camera's",
            )
            self._forget_bias()
            return
        share = (self._bias_stddev * since_s / error) ** 2
        self._bias = self._bias + share * off / since_s
        self._bias_stddev = max(self._bias_stddev * math.sqrt(1 - share), MIN_BIAS_STDDEV)

    def _turned(self, mid_s: float, solver: Solver) -> tuple[PointingPrior, float] | None:
        """The last attitude, turned on to a time, and its error, one sigma an axis (rad); None where readings lack."""
        seen = self._seen
        if seen is None or self._readings is None:
            return None
        turn = self._readings.turn(self._seen_s, mid_s, MAX_MISSING_S, self._bias)
        if turn is None:
            return None
        link, since_s = _link(solver), mid_s - self._seen_s
        turned = PointingPrior(link @ turn.T @ link.T @ seen.attitude, seen.focal_px)
        angle = float(np.linalg.norm(rotation.to_vector(turned.attitude @ seen.attitude.T)))
        shares = math.hypot(WORST.scale_stddev, WORST.axes_stddev, MOUNT_RAD)
        noise = WORST.gyroscope_noise_density * math.sqrt(since_s)
        return turned, math.hypot(noise, self._bias_stddev * since_s, shares * angle)


def _link(solver: Solver) -> np.ndarray:
    """The IMU's axes into C (3, 3)."""
    return np.asarray(solver.instrument.link_to_camera, float)

# SPDX-License-Identifier: Apache-2.0
"""Rotations between camera, inclinometer and base link, as matrices with their errors."""

from dataclasses import dataclass

import numpy as np

from starpos import rotation
from starpos.errors import InstrumentError
from starpos.instrument.inclinometer import EXACT, InclinometerErrors, Tilt, up_of
from starpos.instrument.response import angles_at, response_columns, stated_variances

# an error of its sine is none of the angle of a vertical axis
LEAST_COSINE = 0.1


@dataclass(frozen=True, kw_only=True)
class Mounting:
    """Rotations between camera, inclinometer and base link, and how well they are known.

    a3                        (3, 3): camera C into inclinometer S
    link_to_camera            (3, 3): base link into C
    calibration_covariance    (3, 3) rad2 of A3 as a small rotation about S's axes; it includes the inclinometer's zero,
                              because only the sum of the two matters
    remounted_rad             1 sigma about each axis of a turn of A3 since then
    inclinometer              its errors
    calibrated_unix_s         time of the calibration; NaN: unknown, then the covariance includes the drift until now
    calibrated_temperature_c  temperature of the inclinometer then; NaN: unknown
    calibrated_tilt           its two or three angles then, rad; an error of its response grows with the distance from
                              them
    response                  (m,) coefficients of its response that were found, or none
    response_covariance       (m, m) of these
    """

    a3: np.ndarray
    link_to_camera: np.ndarray
    calibration_covariance: np.ndarray
    remounted_rad: float = 0.0
    inclinometer: InclinometerErrors = EXACT
    calibrated_unix_s: float = float("nan")
    calibrated_temperature_c: float = float("nan")
    calibrated_tilt: tuple[float, ...] = (0.0, 0.0)
    response: tuple[float, ...] = ()
    response_covariance: tuple = ()

    @property
    def calibrated_up(self) -> np.ndarray:
        """Up (3,) in S at the calibration."""
        return up_of(np.asarray(self.calibrated_tilt))

    def response_at(self, tilt: Tilt) -> tuple[np.ndarray, np.ndarray]:
        """Change (3, m) of up for each coefficient of the response at a tilt, and their covariance (m, m).

        Zeros that nobody found are as wrong as the axes contradict each other.
        """
        if not self.response:
            # of three axes those that agree, as the calibration's do: so nothing counts at its lean
            theta = angles_at(tilt.up, tilt.axes)
            variances = stated_variances(self.inclinometer, tilt.axes)
            wrong = self.inclinometer.contradiction(tilt) / np.maximum(np.cos(theta), LEAST_COSINE)
            variances[: tilt.axes] += wrong**2
            return response_columns(theta, self.calibrated_up), np.diag(variances)
        columns = response_columns(tilt.theta, self.calibrated_up)
        if columns.shape[1] != len(self.response):
            raise InstrumentError(
                f"the calibration's response has {len(self.response)} coefficients, and a tilt of {tilt.axes} axes needs "
                f"{columns.shape[1]}: calibrate with the inclinometer that is used"
            )
        return columns, np.asarray(self.response_covariance)

    def up(self, tilt: Tilt) -> np.ndarray:
        """Up (3,) in S, corrected by the response."""
        if not self.response:
            return tilt.up
        columns, _ = self.response_at(tilt)
        return rotation.normalised(tilt.up - columns @ self.response)

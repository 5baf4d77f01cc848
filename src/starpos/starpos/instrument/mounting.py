# SPDX-License-Identifier: Apache-2.0
"""Rotations between camera, inclinometer and base link, as matrices with their errors."""

from dataclasses import dataclass

import numpy as np

from starpos.instrument.inclinometer import EXACT, InclinometerErrors


@dataclass(frozen=True, kw_only=True)
class Mounting:
    """Rotations between camera, inclinometer and base link, and how well they are known.

    a3                        (3, 3): camera C into inclinometer S
    link_to_camera            (3, 3): base link into C
    calibration_covariance    (3, 3) rad2 of A3 as a small rotation about S's axes; it includes the inclinometer's zero,
                              because only the sum of the two matters
    inclinometer              its errors
    calibrated_unix_s         time of the calibration; NaN: unknown, then the covariance includes the drift until now
    calibrated_temperature_c  temperature of the inclinometer then; NaN: unknown
    calibrated_tilt           its tilt then, rad; an error of its scale grows with the distance from it
    """

    a3: np.ndarray
    link_to_camera: np.ndarray
    calibration_covariance: np.ndarray
    inclinometer: InclinometerErrors = EXACT
    calibrated_unix_s: float = float("nan")
    calibrated_temperature_c: float = float("nan")
    calibrated_tilt: tuple[float, float] = (0.0, 0.0)

# SPDX-License-Identifier: Apache-2.0
"""How camera, inclinometer and base link are fixed to each other, and how well that is known."""

from dataclasses import dataclass

import numpy as np

from starpos.instrument.inclinometer import EXACT, InclinometerErrors


@dataclass(frozen=True, kw_only=True)
class Mounting:
    """How the parts are fixed to each other: A3 (camera C into inclinometer S) and base link into C, (3, 3) each.

    calibration_covariance (3, 3) rad2: of A3 as a small rotation about S's axes, the inclinometer's zero included
    (only the sum of the two matters), as of calibrated_unix_s and calibrated_temperature_c; NaN: not known, then what the
    zero wandered till now is taken for a part of it.  An error of the scale counts from calibrated_tilt on.
    """

    a3: np.ndarray
    link_to_camera: np.ndarray
    calibration_covariance: np.ndarray
    inclinometer: InclinometerErrors = EXACT
    calibrated_unix_s: float = float("nan")
    calibrated_temperature_c: float = float("nan")
    calibrated_tilt: tuple[float, float] = (0.0, 0.0)  # rad

# SPDX-License-Identifier: Apache-2.0
"""Tells tilts or an A3 that cannot be right: they have the camera look through the ground."""

import numpy as np

from starpos.earth.refraction import MIN_COS_ZENITH
from starpos.errors import FixError
from starpos.fix.fix import Fix
from starpos.instrument.instrument import Calibration


def check_above_horizon(fix: Fix, calibration: Calibration) -> None:
    """Raise FixError if the camera looks below the horizon, or where no refraction is known.

    While A3 is not known, as before it is found by turning, this tells nothing.
    """
    if calibration.unknown or np.cos(fix.zenith_distance) >= MIN_COS_ZENITH:
        return
    altitude_deg = 90 - np.degrees(fix.zenith_distance)
    side = "above" if altitude_deg > 0 else "below"
    least_deg = np.degrees(np.arcsin(MIN_COS_ZENITH))
    raise FixError(
        f"by the tilts and A3 the camera looks {abs(altitude_deg):.1f} deg {side} the horizon, and stars tell a place "
        f"from {least_deg:.0f} deg above it: check the signs and the order of the inclinometer's axes, and A3"
    )

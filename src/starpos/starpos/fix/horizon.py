# SPDX-License-Identifier: Apache-2.0
"""Tells tilts or an A3 that cannot be right: they have the camera look through the ground."""

import numpy as np

from starpos.earth.refraction import MIN_COS_ZENITH
from starpos.errors import FixError
from starpos.instrument.instrument import Calibration


def check_above_horizon(sine: float, calibration: Calibration) -> None:
    """Raise FixError if a camera's stars are below the horizon, or where no refraction is known.

    sine: of the altitude of their middle by the tilts and A3. While A3 is not known, as before it is found by turning,
    this tells nothing.
    """
    if calibration.unknown or sine >= MIN_COS_ZENITH:
        return
    altitude_deg = np.degrees(np.arcsin(max(sine, -1.0)))
    side = "above" if altitude_deg > 0 else "below"
    least_deg = np.degrees(np.arcsin(MIN_COS_ZENITH))
    raise FixError(
        f"by the tilts and A3 the stars are {abs(altitude_deg):.1f} deg {side} the horizon, and stars tell a place "
        f"from {least_deg:.0f} deg above it: check the signs and the order of the inclinometer's axes, and A3"
    )

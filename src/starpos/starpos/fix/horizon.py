# SPDX-License-Identifier: Apache-2.0
"""Detects tilts, an A3 or a place that cannot be right, as the camera would look through the ground."""

import numpy as np

from starpos.earth.refraction import MIN_COS_ZENITH
from starpos.errors import FixError, PlaceError
from starpos.instrument.instrument import Calibration

# Lowest altitude with a known refraction.
MIN_DEG = np.degrees(np.arcsin(MIN_COS_ZENITH))


def check_above_horizon(sine: float, calibration: Calibration) -> None:
    """Raise FixError if a camera's stars are below the horizon, or where no refraction is known.

    sine: of the altitude of their middle by the tilts and A3. While A3 is not known, as before it is found by turning,
    this has no meaning.
    """
    if not calibration.unknown and sine < MIN_COS_ZENITH:
        raise FixError(
            f"by the tilts and A3 the stars are {_where(sine)}, and a position needs stars {MIN_DEG:.0f} "
            f"deg or more above it: check the signs and the order of the inclinometer's axes, and A3"
        )


def check_visible(sine: float) -> None:
    """Raise PlaceError if a camera's stars cannot be seen from a known place; sine: of the altitude of the lowest."""
    if sine < MIN_COS_ZENITH:
        raise PlaceError(
            f"from the given place the stars, or some, are {_where(sine)}, and a heading needs stars "
            f"{MIN_DEG:.0f} deg or more above it: check latitude and longitude, their order and signs, "
            f"and the clock"
        )


def _where(sine: float) -> str:
    altitude_deg = np.degrees(np.arcsin(max(sine, -1.0)))
    return f"{abs(altitude_deg):.1f} deg {'above' if altitude_deg > 0 else 'below'} the horizon"

# SPDX-License-Identifier: Apache-2.0
"""Places, angles and errors as people read them: degrees or arcseconds, metres or kilometres."""

import math
from dataclasses import dataclass

import numpy as np

from starpos.units import ARCSEC

# lengths from here on are given in km
LONG_M = 10_000.0


def length_text(metres: float, digits: int = 0) -> str:
    """A length in m, or where metres mean nothing in km."""
    return f"{metres:.{digits}f} m" if abs(metres) < LONG_M else f"{metres / 1000:.0f} km"


def angle_text(rad: float) -> str:
    """An angle in arcsec, or from 1 deg in deg."""
    arcsec = rad / ARCSEC
    return f"{arcsec:.0f} arcsec" if arcsec < 3600 else f"{arcsec / 3600:.2f} deg"


@dataclass(frozen=True, kw_only=True)
class InDegrees:
    """A place and a heading in degrees, with 1 sigma of each; a heading that is not known is NaN.

    sigma_east_m, sigma_north_m: of the place.
    """

    latitude: float
    longitude: float
    heading: float
    sigma_east_m: float
    sigma_north_m: float
    sigma_heading: float

    @classmethod
    def of(cls, latitude: float, longitude: float, heading: float, covariance: np.ndarray) -> "InDegrees":
        """Make it of angles in rad and the covariance (3, 3) of east m, north m, heading rad."""
        east, north, turn = np.sqrt(np.diag(covariance)).tolist()
        return cls(
            latitude=math.degrees(latitude),
            longitude=math.degrees(longitude),
            heading=math.degrees(heading),
            sigma_east_m=east,
            sigma_north_m=north,
            sigma_heading=math.degrees(turn),
        )

    @property
    def where(self) -> str:
        """The place with its errors."""
        errors = f"+- {length_text(self.sigma_north_m)} N {length_text(self.sigma_east_m)} E"
        return f"{self.latitude:+.6f} {self.longitude:+.6f} {errors}"

    @property
    def facing(self) -> str:
        """The heading with its error; that it is not known."""
        if math.isnan(self.heading):
            return "heading not known: the camera was touched, or its roll is unknown"
        return f"heading {self.heading:.4f} +- {self.sigma_heading:.4f} deg"

    def __str__(self) -> str:
        return f"{self.where}, {self.facing}"

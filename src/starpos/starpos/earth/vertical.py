# SPDX-License-Identifier: Apache-2.0
"""The deflection of the vertical, which takes astronomic places and headings into geodetic ones.

Signs and symbols: docs/frames_and_symbols.md#the-vertical.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from starpos.earth.ellipsoid import curvature_radii_m
from starpos.errors import InstrumentError
from starpos.rotation import full_turn
from starpos.units import ARCSEC

# Standard deviation of each component if nothing is known: the root mean square over the continents.
UNKNOWN_STDDEV_ARCSEC = 6.0


class Vertical(Protocol):
    """A source of the deflection of the vertical: a Deflection, the same everywhere, or a geoid.Geoid."""

    def at(self, latitude: float, longitude: float) -> "Deflection":
        """The Deflection at a place in rad, with its error; never raises."""


@dataclass(frozen=True)
class Deflection:
    """Components xi (north) and eta (east) in arcsec, with the 1 sigma of each; InstrumentError if not finite."""

    xi_arcsec: float = 0.0
    eta_arcsec: float = 0.0
    stddev_arcsec: float = UNKNOWN_STDDEV_ARCSEC

    def __post_init__(self) -> None:
        if (
            not np.isfinite([self.xi_arcsec, self.eta_arcsec, self.stddev_arcsec]).all()
            or self.stddev_arcsec < 0
        ):
            raise InstrumentError(
                "deflection of the vertical: xi and eta must be finite, their stddev 0 or more"
            )

    def at(self, latitude: float, longitude: float) -> "Deflection":
        """The deflection itself, which is the same everywhere."""
        return self


@dataclass(frozen=True)
class Geodetic:
    """Latitude, longitude and heading (rad) on WGS 84.

    covariance  (3, 3) of east (m), north (m) and heading (rad)
    deflection  the Deflection that was applied
    """

    latitude: float
    longitude: float
    heading: float
    covariance: np.ndarray
    deflection: Deflection


def astronomic(latitude: float, longitude: float, d: Deflection) -> tuple[float, float]:
    """Astronomic latitude and longitude (rad) of a geodetic place; the inverse of `geodetic`."""
    east = d.eta_arcsec * ARCSEC / max(np.cos(latitude), 1e-9)
    return latitude + d.xi_arcsec * ARCSEC, longitude + east


def geodetic(
    latitude: float, longitude: float, heading: float, covariance: np.ndarray, vertical: Vertical
) -> Geodetic:
    """Turn an astronomic place and heading (rad) into geodetic ones; the deflection's error is added to the covariance.

    phi = Phi - xi, lambda = Lambda - eta / cos(phi), azimuth = A - eta tan(phi). covariance (3, 3) is that of Geodetic.
    """
    d = vertical.at(latitude, longitude)
    phi = latitude - d.xi_arcsec * ARCSEC
    eta = d.eta_arcsec * ARCSEC
    cos_phi = max(np.cos(phi), 1e-9)
    lam = (longitude - eta / cos_phi + np.pi) % (2 * np.pi) - np.pi
    azimuth = heading - eta * np.tan(phi)
    prime, meridian = curvature_radii_m(phi)
    xi_moves = np.array([0.0, meridian, 0.0])
    eta_moves = np.array([prime, 0.0, np.sin(phi) / cos_phi])
    sigma = d.stddev_arcsec * ARCSEC
    extra = (np.outer(xi_moves, xi_moves) + np.outer(eta_moves, eta_moves)) * sigma**2
    return Geodetic(float(phi), float(lam), full_turn(azimuth), covariance + extra, d)

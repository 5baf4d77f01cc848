# SPDX-License-Identifier: Apache-2.0
"""The deflection of the vertical, which takes astronomic places and headings into geodetic ones.

Signs and symbols: docs/frames_and_symbols.md#the-vertical.
"""

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from starpos import rotation
from starpos.earth.ellipsoid import ECCENTRICITY2, curvature_radii_m, enu_axes, meridian_turn, place_of_zenith
from starpos.errors import InstrumentError
from starpos.frozen import at_once
from starpos.rotation import full_turn
from starpos.units import ARCSEC

# Standard deviation of each component if nothing is known: the root mean square over the continents.
UNKNOWN_STDDEV_ARCSEC = 6.0
# Root mean square height of land, for a height that is not stated: the mean is 0.8 km (ETOPO1), and heights are spread
# about as an exponential distribution.
UNKNOWN_HEIGHT_M = 1200.0
# Somigliana's constant of normal gravity, WGS 84 (NIMA TR8350.2, table 3.4).
SOMIGLIANA_K = 1.931852652e-3


class Vertical(Protocol):
    """A source of the deflection of the vertical: a Deflection, the same everywhere, a geoid.Geoid, or one AtHeight."""

    def at(self, latitude: float, longitude: float) -> "Deflection":
        """The Deflection at a place in rad, with its error; never raises."""


@dataclass(frozen=True)
class Deflection:
    """Components of the deflection of the vertical; InstrumentError if not finite.

    North and east are at the place that the Deflection is asked for; close to a pole they change with every step.

    Attributes
    ----------
    xi_arcsec, eta_arcsec : to the north and to the east
    stddev_arcsec : 1 sigma of each
    curvature_arcsec : the part of xi that is the curvature of normal plumb lines, which a height alone gives

    Examples
    --------
    >>> slope = starpos.Deflection(xi_arcsec=3.0, eta_arcsec=-7.0, stddev_arcsec=0.5)
    >>> starpos.open_night("night", vertical=slope)
    <night: 5 frames and tilt.csv, to be solved>
    """

    xi_arcsec: float = 0.0
    eta_arcsec: float = 0.0
    stddev_arcsec: float = UNKNOWN_STDDEV_ARCSEC
    curvature_arcsec: float = 0.0

    def __post_init__(self) -> None:
        if (
            not np.isfinite([self.xi_arcsec, self.eta_arcsec, self.stddev_arcsec]).all()
            or self.stddev_arcsec < 0
        ):
            raise InstrumentError(
                "deflection of the vertical: xi and eta must be finite, their stddev 0 or more"
            )

    @property
    def known(self) -> bool:
        """Whether anything is known of it beyond the curvature."""
        own = self.xi_arcsec - self.curvature_arcsec, self.eta_arcsec
        return own != (0, 0) or self.stddev_arcsec < UNKNOWN_STDDEV_ARCSEC

    def at(self, latitude: float, longitude: float) -> "Deflection":
        """The deflection itself, which is the same everywhere."""
        return self


@dataclass(frozen=True)
class AtHeight:
    """A Vertical at a height above the ellipsoid: a deflection at the geoid, and the plumb line's curvature above it.

    Level surfaces come closer to each other towards the poles, so plumb lines curve, and the zenith of gravity moves
    towards the pole with height: in the normal gravity field by 0.171 arcsec sin(2 phi) for each km. By that the
    astronomic latitude is too large (Heiskanen and Moritz, Physical Geodesy (1967), section 5-6, which has the
    correction with its minus sign). What mountains add is not known here; the error of a geoid's slopes includes it.

    vertical: at the geoid.  height_m, stddev_m: NaN for a height that is not known, which widens the error.
    """

    vertical: Vertical
    height_m: float = float("nan")
    stddev_m: float = 0.0

    def at(self, latitude: float, longitude: float) -> "Deflection":
        """The Deflection of `vertical` with the curvature in xi, and in its error what is not known of the height."""
        d, per_m = self.vertical.at(latitude, longitude), plumb_curvature_arcsec_per_m(latitude)
        known = np.isfinite(self.height_m)
        height_m, stddev_m = (self.height_m, self.stddev_m) if known else (0.0, UNKNOWN_HEIGHT_M)
        return replace(
            d,
            xi_arcsec=d.xi_arcsec + per_m * height_m,
            curvature_arcsec=per_m * height_m,
            stddev_arcsec=float(np.hypot(d.stddev_arcsec, per_m * stddev_m)),
        )


def plumb_curvature_arcsec_per_m(latitude: float) -> float:
    """Change of the zenith of normal gravity to the north with height, arcsec per m at a latitude in rad.

    It is the gradient of gravity to the north over gravity, of Somigliana's formula; good to 1 % up to 20 km.
    """
    sin2 = np.sin(latitude) ** 2
    share = SOMIGLIANA_K / (1 + SOMIGLIANA_K * sin2) + ECCENTRICITY2 / (2 * (1 - ECCENTRICITY2 * sin2))
    _, meridian = curvature_radii_m(latitude)
    return float(share * np.sin(2 * latitude) / meridian / ARCSEC)


@at_once
@dataclass(frozen=True, kw_only=True)
class Geodetic:
    """Latitude, longitude and heading (rad) on WGS 84.

    covariance             (3, 3) of east (m), north (m) and heading (rad), along the axes of this place
    deflection             the Deflection that was applied
    deflection_covariance  (3, 3) that part of `covariance` which is the deflection's
    azimuth_turn           rad by which azimuths grow from the astronomic north to the geodetic one
    """

    latitude: float
    longitude: float
    heading: float
    covariance: np.ndarray
    deflection: Deflection
    deflection_covariance: np.ndarray
    azimuth_turn: float


def astronomic(latitude: float, longitude: float, d: Deflection) -> tuple[float, float]:
    """Astronomic latitude and longitude (rad) of a geodetic place; the inverse of `geodetic`."""
    return place_of_zenith(_leaned(enu_axes(latitude, longitude), d, 1)[2])


def geodetic(
    latitude: float, longitude: float, heading: float, covariance: np.ndarray, vertical: Vertical
) -> Geodetic:
    """Turn an astronomic place and heading (rad) into geodetic ones; the deflection's error is added to the covariance.

    The zenith turns by the deflection, about axes of the astronomic place, and the axes turn with it. Far from the
    poles that is phi = Phi - xi, lambda = Lambda - eta / cos(phi), azimuth = A - eta tan(phi); it holds at a pole too.

    Parameters
    ----------
    latitude, longitude, heading : astronomic, rad; an unknown heading is NaN
    covariance : (3, 3) of east (m), north (m), heading (rad) at the astronomic place
    vertical : its deflection there is removed

    Returns
    -------
    Geodetic
        on WGS 84, in rad

    Examples
    --------
    >>> slope = starpos.Deflection(xi_arcsec=10.0, eta_arcsec=0.0, stddev_arcsec=1.0)
    >>> ground = starpos.geodetic(0.6, 0.9, 0.0, np.zeros((3, 3)), slope)
    >>> print(round(np.degrees(0.6 - ground.latitude) * 3600, 3))  # arcsec
    10.0
    """
    d = vertical.at(latitude, longitude)
    carried = _leaned(enu_axes(latitude, longitude), d, -1)
    phi, lam = place_of_zenith(carried[2])
    # azimuth, here, of the north that was carried along
    turn = float(np.arctan2(*(enu_axes(phi, lam)[:2] @ carried[1])))
    prime, meridian = curvature_radii_m(phi)
    # turns of north for a metre to the east, here and at the astronomic place
    here, there = meridian_turn(phi) / prime, meridian_turn(latitude) / curvature_radii_m(latitude)[0]
    c, s = np.cos(turn), np.sin(turn)
    moved = np.array([[c, s, 0.0], [-s, c, 0.0], [here * c - there, here * s, 1.0]])
    errors = np.array([[prime, 0.0], [0.0, meridian], [here * prime, 0.0]]) * d.stddev_arcsec * ARCSEC
    extra, turned = errors @ errors.T, moved @ covariance @ moved.T
    # an unknown heading, which is NaN, leaves the place as it is
    turned[:2, :2] = moved[:2, :2] @ covariance[:2, :2] @ moved[:2, :2].T
    return Geodetic(
        latitude=phi,
        longitude=lam,
        heading=full_turn(heading + turn),
        covariance=turned + extra,
        deflection=d,
        deflection_covariance=extra,
        azimuth_turn=turn,
    )


def _leaned(axes: np.ndarray, d: Deflection, sign: int) -> np.ndarray:
    """East, north, up (3, 3) turned so that up leans by a deflection (sign 1) or against it (-1)."""
    east, north, up = axes
    lean = sign * ARCSEC * (d.xi_arcsec * north + d.eta_arcsec * east)
    return axes @ rotation.from_vector(np.cross(up, lean)).T

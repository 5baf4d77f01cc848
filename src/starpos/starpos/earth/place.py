# SPDX-License-Identifier: Apache-2.0
"""A place on the Earth: up and north there, by the plumb line and by the ellipsoid, and how well it is known."""

import math
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from starpos.earth.ellipsoid import curvature_radii_m, enu_axes, zenith_of
from starpos.earth.vertical import Deflection, Vertical, astronomic, geodetic
from starpos.errors import PlaceError
from starpos.frozen import at_once
from starpos.rotation import about_axis, half_turn
from starpos.units import ARCSEC

# a survey mark's place is known to less than a millimetre of up
EXACT_M2 = np.zeros((2, 2))
# the plumb line is taken for the ellipsoid's normal
UNDEFLECTED = Deflection(0.0, 0.0, 0.0)


class Places(Protocol):
    """Where the instrument is known to be: a Place, or several by their times."""

    def at(self, utc_unix_s: float) -> "Place":
        """The place at a time; raises PlaceError where it is not known."""


@at_once
@dataclass(frozen=True, kw_only=True)
class Place:
    """A place on the Earth; make it by `on_ellipsoid` or `by_gravity`.

    Attributes
    ----------
    latitude, longitude : on WGS 84 (geodetic), rad
    plumb : (latitude, longitude) by the plumb line (astronomic), rad
    height_m : above the ellipsoid; NaN: not known
    covariance : (2, 2) of the place itself, east and north, m2
    deflection : between the two zeniths
    plumb_stddev, ellipsoid_stddev : error in rad that the deflection leaves in a component of each zenith; the stated one
        has none
    utc_unix_s : when it was there; NaN: it holds for any time

    Examples
    --------
    >>> place = starpos.Place.on_ellipsoid(35.7046, 51.4106, starpos.Deflection(10.0, 0.0, 1.0))
    >>> print(round(np.degrees(place.plumb[0] - place.latitude) * 3600, 3))  # arcsec
    10.0
    """

    latitude: float
    longitude: float
    plumb: tuple[float, float]
    covariance: np.ndarray
    deflection: Deflection = UNDEFLECTED
    plumb_stddev: float = 0.0
    ellipsoid_stddev: float = 0.0
    height_m: float = math.nan
    utc_unix_s: float = math.nan

    @classmethod
    def on_ellipsoid(
        cls,
        latitude_deg: float,
        longitude_deg: float,
        vertical: Vertical = UNDEFLECTED,
        covariance: np.ndarray = EXACT_M2,
        height_m: float = math.nan,
        utc_unix_s: float = math.nan,
    ) -> "Place":
        """A place on WGS 84, as a map or a receiver has it; PlaceError if there is no such place.

        vertical: the deflection there.  covariance (2, 2): of east and north, m2.
        """
        latitude, longitude = _checked(latitude_deg, longitude_deg, covariance)
        return cls(
            latitude=latitude,
            longitude=longitude,
            plumb=(latitude, longitude),
            covariance=np.asarray(covariance, float),
            height_m=height_m,
            utc_unix_s=utc_unix_s,
        ).deflected(vertical)

    @classmethod
    def by_gravity(
        cls,
        latitude_deg: float,
        longitude_deg: float,
        vertical: Vertical = UNDEFLECTED,
        covariance: np.ndarray = EXACT_M2,
    ) -> "Place":
        """An astronomic place, as a star fix has it; PlaceError if there is no such place."""
        plumb = _checked(latitude_deg, longitude_deg, covariance)
        ground = geodetic(*plumb, 0.0, np.zeros((3, 3)), vertical)
        return cls(
            latitude=ground.latitude,
            longitude=ground.longitude,
            plumb=plumb,
            covariance=np.asarray(covariance, float),
            deflection=ground.deflection,
            ellipsoid_stddev=ground.deflection.stddev_arcsec * ARCSEC,
        )

    def deflected(self, vertical: Vertical) -> "Place":
        """This place on the ellipsoid, with the plumb line leaning as a Vertical has it there."""
        if vertical is UNDEFLECTED:
            return self
        d = vertical.at(self.latitude, self.longitude)
        return replace(
            self,
            plumb=astronomic(self.latitude, self.longitude, d),
            deflection=d,
            plumb_stddev=d.stddev_arcsec * ARCSEC,
            ellipsoid_stddev=0.0,
        )

    def at(self, utc_unix_s: float) -> "Place":
        """Return itself: one place holds for any time; `Places` has the same method."""
        return self

    @property
    def zenith(self) -> np.ndarray:
        """Up (3,) in ITRS by the ellipsoid."""
        return zenith_of(self.latitude, self.longitude)

    @property
    def axes(self) -> np.ndarray:
        """Rotation (3, 3) of ITRS into east, north, up by the ellipsoid."""
        return enu_axes(self.latitude, self.longitude)

    @property
    def plumb_axes(self) -> np.ndarray:
        """Rotation (3, 3) of ITRS into east, north, up by the plumb line."""
        return enu_axes(*self.plumb)

    @property
    def to_geodetic_north(self) -> np.ndarray:
        """Rotation (3, 3) about up from the plumb line's north to the ellipsoid's."""
        north = self.axes @ self.plumb_axes[1]
        return about_axis(2, -math.atan2(north[0], north[1]))

    @property
    def zenith_root(self) -> np.ndarray:
        """Root (2, 2) in rad of the covariance of the zenith's east and north that the place's own error makes."""
        values, vectors = np.linalg.eigh(self.covariance)
        radii = np.array(curvature_radii_m(self.latitude))
        return vectors * np.sqrt(np.maximum(values, 0.0)) / radii[:, None]

    def offset_m(self, latitude: float, longitude: float) -> np.ndarray:
        """East, north (2,) in m from another place on the ellipsoid (rad) to this one."""
        prime, meridian = curvature_radii_m(latitude)
        east = half_turn(self.longitude - longitude) * prime * np.cos(latitude)
        return np.array([east, (self.latitude - latitude) * meridian])


def _checked(latitude_deg: float, longitude_deg: float, covariance: np.ndarray) -> tuple[float, float]:
    """Latitude and longitude in rad; raises PlaceError."""
    # false for NaN too
    if not (abs(latitude_deg) <= 90 and abs(longitude_deg) <= 360):
        raise PlaceError(
            f"no place is at latitude {latitude_deg:g}, longitude {longitude_deg:g}: give the latitude first, -90 to 90 "
            "deg, then the longitude, -180 to 180 deg, east and north positive"
        )
    covariance = np.asarray(covariance, float)
    if (
        covariance.shape != (2, 2)
        or not np.isfinite(covariance).all()
        or np.linalg.eigvalsh(covariance)[0] < 0
    ):
        raise PlaceError("the covariance of a place is 2 x 2 finite numbers, m2, without negative variances")
    return math.radians(latitude_deg), math.radians(longitude_deg)

# SPDX-License-Identifier: Apache-2.0
"""A place that is known: where up and north are there, by the plumb line and by the ellipsoid, and how well."""

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from starpos.earth.ellipsoid import curvature_radii_m, enu_axes
from starpos.earth.vertical import Deflection, Vertical, astronomic, geodetic
from starpos.errors import PlaceError
from starpos.frozen import at_once
from starpos.units import ARCSEC

# a survey mark's place is known to less than a millimetre of up
EXACT_M2 = np.zeros((2, 2))


class Places(Protocol):
    """Where the instrument is known to be: a KnownPlace, or several by their times."""

    def at(self, utc_unix_s: float) -> "KnownPlace":
        """The place at a time; raises PlaceError where it is not known."""


@at_once
@dataclass(frozen=True, kw_only=True)
class KnownPlace:
    """A place on the Earth; make it by `on_ellipsoid` or `by_gravity`.

    plumb, ellipsoid: (latitude, longitude) in rad, astronomic and on WGS 84.
    covariance (2, 2): of the place itself, east and north, m2.
    deflection: between the two.
    plumb_stddev, ellipsoid_stddev: error in rad that the deflection leaves in a component of each zenith; the stated one
    has none.
    """

    plumb: tuple[float, float]
    ellipsoid: tuple[float, float]
    covariance: np.ndarray
    deflection: Deflection
    plumb_stddev: float
    ellipsoid_stddev: float

    @classmethod
    def on_ellipsoid(
        cls,
        latitude_deg: float,
        longitude_deg: float,
        vertical: Vertical,
        covariance: np.ndarray = EXACT_M2,
    ) -> "KnownPlace":
        """A place on WGS 84, as a map or a receiver has it; PlaceError if there is no such place.

        vertical: the deflection there.  covariance (2, 2): of east and north, m2.
        """
        place = _checked(latitude_deg, longitude_deg, covariance)
        d = vertical.at(*place)
        return cls(
            plumb=astronomic(*place, d),
            ellipsoid=place,
            covariance=np.asarray(covariance, float),
            deflection=d,
            plumb_stddev=d.stddev_arcsec * ARCSEC,
            ellipsoid_stddev=0.0,
        )

    @classmethod
    def by_gravity(
        cls,
        latitude_deg: float,
        longitude_deg: float,
        vertical: Vertical,
        covariance: np.ndarray = EXACT_M2,
    ) -> "KnownPlace":
        """An astronomic place, as a star fix has it; PlaceError if there is no such place."""
        place = _checked(latitude_deg, longitude_deg, covariance)
        ground = geodetic(*place, 0.0, np.zeros((3, 3)), vertical)
        return cls(
            plumb=place,
            ellipsoid=(ground.latitude, ground.longitude),
            covariance=np.asarray(covariance, float),
            deflection=ground.deflection,
            plumb_stddev=0.0,
            ellipsoid_stddev=ground.deflection.stddev_arcsec * ARCSEC,
        )

    def at(self, utc_unix_s: float) -> "KnownPlace":
        """Return itself: one place holds for any time; `Places` has the same method."""
        return self

    @property
    def plumb_axes(self) -> np.ndarray:
        """Rotation (3, 3) of ITRS into east, north, up by the plumb line."""
        return enu_axes(*self.plumb)

    @property
    def ellipsoid_axes(self) -> np.ndarray:
        """Rotation (3, 3) of ITRS into east, north, up by the ellipsoid."""
        return enu_axes(*self.ellipsoid)

    @property
    def zenith_root(self) -> np.ndarray:
        """Root (2, 2) in rad of the covariance of the zenith's east and north that the place's own error makes."""
        values, vectors = np.linalg.eigh(self.covariance)
        return (
            vectors
            * np.sqrt(np.maximum(values, 0.0))
            / np.array(curvature_radii_m(self.ellipsoid[0]))[:, None]
        )


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

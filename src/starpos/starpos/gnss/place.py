# SPDX-License-Identifier: Apache-2.0
"""A place by GNSS, and why one cannot be used."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from starpos.earth.ellipsoid import curvature_radii_m, enu_axes, zenith_of
from starpos.earth.known_place import KnownPlace
from starpos.earth.vertical import Vertical
from starpos.errors import GnssError
from starpos.messages.stamp import stamp_to_unix
from starpos.rotation import half_turn

# Names of datums that lie up to kilometres off NavSatFix's, WGS 84.
OTHER_DATUMS = (
    "nad27",
    "nad83",
    "ed50",
    "osgb",
    "gcj02",
    "gcj-02",
    "bd09",
    "bd-09",
    "pz90",
    "pz-90",
    "tokyo",
    "sk42",
    "sk-42",
)
# A receiver that states a larger error gives no place.
MAX_SIGMA_M = 10_000.0
# A receiver's default output before it has a place.
NULL_ISLAND_DEG = 1e-5


@dataclass(frozen=True, eq=False, kw_only=True)
class GnssPlace:
    """Latitude and longitude on WGS 84 (rad), and the covariance (2, 2) of east and north, m2."""

    utc_unix_s: float
    latitude: float
    longitude: float
    covariance: np.ndarray

    @property
    def zenith(self) -> np.ndarray:
        """Up (3,) in ITRS by the ellipsoid."""
        return zenith_of(self.latitude, self.longitude)

    @property
    def axes(self) -> np.ndarray:
        """East, north, up (3, 3) in ITRS by the ellipsoid."""
        return enu_axes(self.latitude, self.longitude)

    def from_place_m(self, latitude: float, longitude: float) -> np.ndarray:
        """East, north (2,) in m from a geodetic place (rad) to this one."""
        prime, meridian = curvature_radii_m(latitude)
        east = half_turn(self.longitude - longitude) * prime * np.cos(latitude)
        return np.array([east, (self.latitude - latitude) * meridian])


def checked(
    utc_unix_s: float, latitude_deg: float, longitude_deg: float, covariance: np.ndarray, status: float
) -> GnssPlace:
    """The place of a receiver's output; GnssError that says why it gives none.

    covariance (2, 2): of east and north, m2.  status: as in NavSatStatus, below 0 without a fix.
    """
    if not status >= 0:
        raise GnssError("GNSS has no fix: give its antenna a clear view of the sky")
    if not np.isfinite([utc_unix_s, latitude_deg, longitude_deg]).all():
        raise GnssError(
            "GNSS states a fix whose time, latitude or longitude is not a number: check its driver"
        )
    if abs(latitude_deg) > 90 or abs(longitude_deg) > 360:
        raise GnssError(
            f"GNSS states latitude {latitude_deg:g}, longitude {longitude_deg:g}: send deg, latitude first"
        )
    if max(abs(latitude_deg), abs(longitude_deg)) < NULL_ISLAND_DEG:
        raise GnssError(
            "GNSS states a fix at 0 N 0 E, a receiver's output before it has a place: it is left out"
        )
    if not np.isfinite(covariance).all() or np.linalg.eigvalsh(covariance)[0] <= 0:
        raise GnssError("GNSS states no error of its place: have its driver fill in the covariance")
    if np.sqrt(np.trace(covariance)) > MAX_SIGMA_M:
        raise GnssError(f"GNSS states an error of over {MAX_SIGMA_M / 1000:g} km: it is left out")
    return GnssPlace(
        utc_unix_s=utc_unix_s,
        latitude=float(np.radians(latitude_deg)),
        longitude=half_turn(np.radians(longitude_deg)),
        covariance=covariance,
    )


def message_to_gnss(message: Any, unstated_m: float = math.nan) -> GnssPlace:
    """The place of a sensor_msgs/NavSatFix; GnssError that says why it has none.

    unstated_m: 1 sigma an axis of a fix that states no error; NaN: such a fix is refused.
    """
    unix_s = stamp_to_unix(message.header.stamp)
    if unix_s is None:
        raise GnssError("a GNSS message has no time stamp: set header.stamp to the time of its fix")
    frame = message.header.frame_id.lower().replace("-", "").replace("_", "")
    if any(datum in frame for datum in OTHER_DATUMS):
        raise GnssError(
            f"GNSS's frame_id {message.header.frame_id[:40]!r} names another datum than WGS 84: set the receiver to that"
        )
    covariance = np.reshape(np.array(message.position_covariance, float), (3, 3))[:2, :2]
    stated = np.isfinite(covariance).all() and np.linalg.eigvalsh(covariance)[0] > 0
    if message.position_covariance_type == 0 or not stated:
        covariance = np.eye(2) * unstated_m**2
    return checked(unix_s, message.latitude, message.longitude, covariance, message.status.status)


def known_place(gnss: GnssPlace, vertical: Vertical) -> KnownPlace:
    """A GNSS place as one that is known, with the deflection there."""
    latitude, longitude = np.degrees([gnss.latitude, gnss.longitude]).tolist()
    return KnownPlace.on_ellipsoid(latitude, longitude, vertical, gnss.covariance)

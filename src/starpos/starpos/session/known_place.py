# SPDX-License-Identifier: Apache-2.0
"""Where a session's instrument is known to be: at the site of the parameters, else where GNSS last had it."""

import math
from typing import Any

from starpos.earth.known_place import KnownPlace
from starpos.errors import PlaceError
from starpos.session.gnss import OLDEST_S, GnssPlace, message_to_gnss
from starpos.session.settings import Settings


class SessionPlaces:
    """The known place at each time, as `Places`."""

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self._gnss: GnssPlace | None = None

    @property
    def known(self) -> bool:
        """Whether anybody is to say where the instrument is."""
        return self._settings.site is not None or bool(self._settings.values["gnss.use"])

    def take(self, message: Any) -> None:
        """Take a sensor_msgs/NavSatFix of satellites; one without a place leaves the last one, which grows old."""
        self._gnss = message_to_gnss(message) or self._gnss

    def at(self, utc_unix_s: float) -> KnownPlace:
        """The place at a time; raises PlaceError where it is not known."""
        if (site := self._settings.site) is not None:
            return site
        gnss = self._gnss
        if gnss is None or abs(utc_unix_s - gnss.utc_unix_s) > OLDEST_S:
            raise PlaceError(
                f"no GNSS place within {OLDEST_S:g} s of the frame: no heading at a known place: check gnss/fix and the "
                "clocks, or set site.latitude and site.longitude"
            )
        latitude, longitude = math.degrees(gnss.latitude), math.degrees(gnss.longitude)
        return KnownPlace.on_ellipsoid(latitude, longitude, self._settings.vertical, gnss.covariance)

    def forget(self) -> None:
        """Forget where GNSS had the instrument."""
        self._gnss = None

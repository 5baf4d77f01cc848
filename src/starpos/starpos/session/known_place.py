# SPDX-License-Identifier: Apache-2.0
"""Where a session's instrument is known to be: at the site of the parameters, else where GNSS has it."""

from starpos.earth.known_place import KnownPlace
from starpos.errors import GnssError, PlaceError
from starpos.gnss.place import known_place
from starpos.gnss.track import NEAREST_S
from starpos.session.gnss_teacher import GnssTeacher
from starpos.session.settings import Settings


class SessionPlaces:
    """The known place at each time, as `Places`.

    gnss: None without gnss.use.
    """

    def __init__(self, settings: Settings, gnss: GnssTeacher | None) -> None:
        self._settings, self._gnss = settings, gnss

    @property
    def known(self) -> bool:
        """Whether a source of the place is set."""
        return self._settings.site is not None or self._gnss is not None

    def at(self, utc_unix_s: float) -> KnownPlace:
        """The place at a time; raises PlaceError where it is not known."""
        if (site := self._settings.site) is not None:
            return site
        try:
            gnss = None if self._gnss is None else self._gnss.place_at(utc_unix_s)
        except GnssError as error:
            raise PlaceError(f"no heading at a known place: {error}") from None
        if gnss is None:
            raise PlaceError(
                f"no GNSS place within {NEAREST_S:g} s of the frame: no heading at a known place: check gnss/fix and the "
                "clocks, or set site.latitude and site.longitude"
            )
        return known_place(gnss, self._settings.vertical)

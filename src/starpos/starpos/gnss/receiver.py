# SPDX-License-Identifier: Apache-2.0
"""GNSS places of a receiver, by messages or a table: checked, and in the order of their time."""

import math
import re
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from starpos.earth.place import Place
from starpos.errors import GnssError
from starpos.messages.stamp import stamp_to_unix
from starpos.rotation import half_turn
from starpos.tables import TableForm

# Names of datums that lie up to kilometres off NavSatFix's, WGS 84, as the last words of a frame_id.
OTHER_DATUMS = ("nad27", "nad83", "ed50", "osgb", "osgb36", "gcj02", "bd09", "pz90", "tokyo", "sk42")
# A receiver that states a larger error gives no place.
MAX_SIGMA_M = 10_000.0
# A receiver's default output before it has a place.
NULL_ISLAND_DEG = 1e-5


def gnss_place(utc_unix_s: float, latitude: float, longitude: float, covariance: np.ndarray) -> Place:
    """A receiver's place at a time: rad on WGS 84, and the covariance (2, 2) of east and north, m2."""
    return Place(
        latitude=latitude,
        longitude=longitude,
        plumb=(latitude, longitude),
        covariance=covariance,
        utc_unix_s=utc_unix_s,
    )


def checked(
    utc_unix_s: float, latitude_deg: float, longitude_deg: float, covariance: np.ndarray, status: float
) -> Place:
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
    longitude = half_turn(np.radians(longitude_deg))
    return gnss_place(utc_unix_s, float(np.radians(latitude_deg)), longitude, covariance)


def message_to_gnss(message: Any, unstated_m: float = math.nan) -> Place:
    """The place of a sensor_msgs/NavSatFix; GnssError that says why it has none.

    unstated_m: 1 sigma an axis of a fix that states no error; NaN: such a fix is refused.
    """
    unix_s = stamp_to_unix(message.header.stamp)
    if unix_s is None:
        raise GnssError("a GNSS message has no time stamp: set header.stamp to the time of its fix")
    if _names_other_datum(message.header.frame_id):
        raise GnssError(
            f"GNSS's frame_id {message.header.frame_id[:40]!r} names another datum than WGS 84: set the receiver to that"
        )
    covariance = np.reshape(np.array(message.position_covariance, float), (3, 3))[:2, :2]
    covariance = (covariance + covariance.T) / 2
    stated = np.isfinite(covariance).all() and np.linalg.eigvalsh(covariance)[0] > 0
    if message.position_covariance_type == 0 or not stated:
        covariance = np.eye(2) * unstated_m**2
    return checked(unix_s, message.latitude, message.longitude, covariance, message.status.status)


def _names_other_datum(frame_id: str) -> bool:
    """Whether the last words of a frame_id, with any signs between them, are the name of another datum."""
    words = re.findall("[a-z0-9]+", frame_id.lower().rpartition("/")[2])
    return any("".join(words[k:]) in OTHER_DATUMS for k in range(len(words)))


# Maximum time between a GNSS place and a frame, s.
NEAREST_S = 3.0
# Maximum speed of a vehicle between two places, m/s, and tolerance beyond it, in sigma of both.
MAX_SPEED, SIGMAS = 150.0, 8.0
# Minimum time between two places that show the speed: the noise of nearer ones would be a speed.
SPEED_S = 1.0
# Stamps closer than this are one.
SAME_S = 1e-4


class GnssTrack:
    """GNSS places by time.

    Two places of one moment that contradict each other give none: two receivers, or a spoofed one.

    Parameters
    ----------
    places : in any order, each with its time

    Examples
    --------
    >>> track = starpos.GnssTrack([starpos.Place.on_ellipsoid(35.7, 51.4, utc_unix_s=1.8e9)])
    >>> track.at(1.8e9 + 100) is None  # no place near that time
    True
    """

    def __init__(self, places: list[Place]) -> None:
        ordered = sorted(places, key=lambda p: p.utc_unix_s)
        self._places = _agreeing(ordered)
        self._times = np.array([p.utc_unix_s for p in self._places])

    def __len__(self) -> int:
        return len(self._places)

    def at(self, utc_unix_s: float) -> Place | None:
        """The place at a time, between the two nearest to it; None without one near.

        GnssError if those contradict each other.
        """
        k = int(np.searchsorted(self._times, utc_unix_s))
        near = [p for p in self._places[max(k - 1, 0) : k + 1] if abs(p.utc_unix_s - utc_unix_s) <= NEAREST_S]
        if not near:
            return None
        if len(near) == 1:
            return self._carried(near[0], utc_unix_s)
        before, after = near
        if not agree(before, after):
            raise GnssError(
                "GNSS's places leap by more than any vehicle drives: check that one receiver publishes, not two"
            )
        step_s = after.utc_unix_s - before.utc_unix_s
        return _between(before, after, (utc_unix_s - before.utc_unix_s) / step_s if step_s > SAME_S else 0.5)

    def _carried(self, place: Place, utc_unix_s: float) -> Place:
        """A place carried to a time after the last one, or before the first, with the error of that way."""
        # the speed is by one that is a second before, or after the first: neighbours of a fast receiver are too near
        k = int(np.searchsorted(self._times, place.utc_unix_s - SPEED_S)) - 1
        if place.utc_unix_s <= self._times[0]:
            k = int(np.searchsorted(self._times, place.utc_unix_s + SPEED_S))
        other = self._places[min(max(k, 0), len(self._places) - 1)]
        span_s = max(abs(place.utc_unix_s - other.utc_unix_s), SPEED_S)
        speed = float(np.linalg.norm(place.offset_m(other.latitude, other.longitude))) / span_s
        way_m = speed * (utc_unix_s - place.utc_unix_s)
        covariance = place.covariance + np.eye(2) * way_m**2
        return gnss_place(utc_unix_s, place.latitude, place.longitude, covariance)


def agree(a: Place, b: Place) -> bool:
    """Whether a vehicle may have gone from one place to the other in the time between them."""
    apart_m = float(np.linalg.norm(a.offset_m(b.latitude, b.longitude)))
    sigma_m = float(np.sqrt(np.linalg.eigvalsh(a.covariance + b.covariance)[-1]))
    return apart_m <= MAX_SPEED * abs(a.utc_unix_s - b.utc_unix_s) + SIGMAS * sigma_m


def _agreeing(ordered: list[Place]) -> list[Place]:
    """One place for each moment; none if a moment's places contradict each other."""
    kept: list[Place] = []
    start = 0
    for end in range(1, len(ordered) + 1):
        if end < len(ordered) and ordered[end].utc_unix_s - ordered[start].utc_unix_s <= SAME_S:
            continue
        if all(agree(ordered[start], other) for other in ordered[start + 1 : end]):
            kept.append(ordered[start])
        start = end
    return kept


def _between(before: Place, after: Place, share: float) -> Place:
    """The place at a share of the way, with the larger error of the two."""
    turn = half_turn(after.longitude - before.longitude)
    larger = max(before, after, key=lambda p: float(np.trace(p.covariance)))
    return gnss_place(
        before.utc_unix_s + share * (after.utc_unix_s - before.utc_unix_s),
        before.latitude + share * (after.latitude - before.latitude),
        before.longitude + share * turn,
        larger.covariance,
    )


# deg on WGS 84, for a month of 1 Hz; a receiver without a fix leaves cells empty
GNSS_TABLE = TableForm(
    what="table of GNSS",
    error=GnssError,
    needed=("utc_unix_s", "latitude", "longitude", "sigma_east_m", "sigma_north_m"),
    optional=("status",),
    broken_rows_are_nan=True,
    may_be_empty=True,
)


def read_gnss_csv(path: Path | str) -> tuple[GnssTrack, tuple[str, ...]]:
    """Read the fixes of a receiver.

    Columns: utc_unix_s, latitude, longitude in deg on WGS 84, sigma_east_m, sigma_north_m; status as NavSatStatus's (0 if
    there is no such column).  Cells may be empty.  Rows may come in any order.

    Parameters
    ----------
    path : of the CSV

    Returns
    -------
    tuple of GnssTrack and tuple of str
        the places by time, and a sentence for each kind of row that was left out

    Raises
    ------
    GnssError
        the file cannot be read or has no such columns

    Examples
    --------
    >>> track, left_out = starpos.read_gnss_csv("gnss.csv")
    >>> len(track), left_out
    (3, ())
    """
    table = GNSS_TABLE.read(path)
    places: list[Place] = []
    faults: Counter[str] = Counter()
    columns = (*(table.columns[name] for name in GNSS_TABLE.needed), table.column("status", 0.0))
    for t, latitude, longitude, east, north, status in np.stack(columns, -1).tolist():
        covariance = np.diag(np.square([east, north])) if min(east, north) > 0 else np.full((2, 2), np.nan)
        try:
            places.append(checked(t, latitude, longitude, covariance, status))
        except GnssError as error:
            faults[str(error)] += 1
    track = GnssTrack(places)
    if len(track) < len(places):
        faults["places of one moment contradict each other: give the fixes of one receiver"] += len(
            places
        ) - len(track)
    return track, tuple(f"{path}: {number} rows left out: {why}" for why, number in faults.most_common())

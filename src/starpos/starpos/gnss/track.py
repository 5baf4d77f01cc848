# SPDX-License-Identifier: Apache-2.0
"""GNSS places in the order of their time: the place at a frame, where they agree on one."""

import numpy as np

from starpos.errors import GnssError
from starpos.gnss.place import GnssPlace

# Maximum time between a GNSS place and a frame, s.
NEAREST_S = 3.0
# Maximum speed of a vehicle between two places, m/s, and tolerance beyond it, in sigma of both.
MAX_SPEED, SIGMAS = 150.0, 8.0
# Stamps closer than this are one.
SAME_S = 1e-4


class GnssTrack:
    """GNSS places by time.

    Two places of one moment that contradict each other give none: two receivers, or a spoofed one.
    """

    def __init__(self, places: list[GnssPlace]) -> None:
        ordered = sorted(places, key=lambda p: p.utc_unix_s)
        self._places = _agreeing(ordered)
        self._times = np.array([p.utc_unix_s for p in self._places])

    def __len__(self) -> int:
        return len(self._places)

    def at(self, utc_unix_s: float) -> GnssPlace | None:
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

    def _carried(self, place: GnssPlace, utc_unix_s: float) -> GnssPlace:
        """A place carried to a time after the last one, or before the first, with the error of that way."""
        k = int(np.searchsorted(self._times, place.utc_unix_s))
        other = self._places[k - 1] if k else self._places[1] if len(self._places) > 1 else place
        span_s = max(abs(place.utc_unix_s - other.utc_unix_s), 1.0)
        speed = float(np.linalg.norm(place.from_place_m(other.latitude, other.longitude))) / span_s
        way_m = speed * (utc_unix_s - place.utc_unix_s)
        return GnssPlace(
            utc_unix_s=utc_unix_s,
            latitude=place.latitude,
            longitude=place.longitude,
            covariance=place.covariance + np.eye(2) * way_m**2,
        )


def agree(a: GnssPlace, b: GnssPlace) -> bool:
    """Whether a vehicle may have gone from one place to the other in the time between them."""
    apart_m = float(np.linalg.norm(a.from_place_m(b.latitude, b.longitude)))
    sigma_m = float(np.sqrt(np.linalg.eigvalsh(a.covariance + b.covariance)[-1]))
    return apart_m <= MAX_SPEED * abs(a.utc_unix_s - b.utc_unix_s) + SIGMAS * sigma_m


def _agreeing(ordered: list[GnssPlace]) -> list[GnssPlace]:
    """One place for each moment; none if a moment's places contradict each other."""
    kept: list[GnssPlace] = []
    start = 0
    for end in range(1, len(ordered) + 1):
        if end < len(ordered) and ordered[end].utc_unix_s - ordered[start].utc_unix_s <= SAME_S:
            continue
        if all(agree(ordered[start], other) for other in ordered[start + 1 : end]):
            kept.append(ordered[start])
        start = end
    return kept


def _between(before: GnssPlace, after: GnssPlace, share: float) -> GnssPlace:
    """The place at a share of the way, with the larger error of the two."""
    latitude = before.latitude + share * (after.latitude - before.latitude)
    turn = np.remainder(after.longitude - before.longitude + np.pi, 2 * np.pi) - np.pi
    larger = max(before, after, key=lambda p: float(np.trace(p.covariance)))
    return GnssPlace(
        utc_unix_s=before.utc_unix_s + share * (after.utc_unix_s - before.utc_unix_s),
        latitude=latitude,
        longitude=before.longitude + share * float(turn),
        covariance=larger.covariance,
    )

# SPDX-License-Identifier: Apache-2.0
"""The trail of a satellite among the stars: what a frame, or an observer's table, says of it."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from starpos.earth.ellipsoid import enu_at_zenith
from starpos.earth.orientation import later
from starpos.frozen import at_once


@at_once
@dataclass(frozen=True, kw_only=True)
class SatelliteTrail:
    """One or two ends of a trail: directions against the catalogue places of the stars around, and their times.

    track: a number of the caller's own.  directions (E, 3): ICRS unit vectors, E 1 or 2.  The stars' aberration and
    refraction are undone as for a star at the same place of the frame, and nothing else.
    covariance (E, 2, 2): rad2 along the directions of growing right ascension and growing declination.
    utc_unix_s (E,): time of each end; the first end is at the opening of the shutter.
    turned_utc_unix_s (E,): the ends' times if the satellite flew the other way; None: the way is known. (With a rolling
    shutter each end has the time of its own row.) The camera then stands on the ground, and `directions` turn with it.
    towards (3,): of a trail with one end, where it leaves the frame, in the axes of the first end's time; None: a
    sighting without a motion.  unseen_utc_unix_s: the time of the end that lies there; None while the way is unknown.
    time_stddev_s: error of the trail's own time, of a stop watch; the clock's, shared by all, is not in it.
    satellite: catalogue number that the observer states, or None.  file: frame that it was seen on, or "".
    """

    track: int
    directions: np.ndarray
    covariance: np.ndarray
    utc_unix_s: np.ndarray
    turned_utc_unix_s: np.ndarray | None = None
    towards: np.ndarray | None = None
    unseen_utc_unix_s: float | None = None
    time_stddev_s: float = 0.0
    satellite: int | None = None
    file: str = ""

    @property
    def moves(self) -> bool:
        """Whether its motion is known, at least in direction."""
        return len(self.directions) > 1 or self.towards is not None

    @property
    def ways(self) -> "Iterator[SatelliteTrail]":
        """The trail as it is, and where its way is unknown, also with the other times; the way of each is known."""
        times = self.turned_utc_unix_s
        if times is None:
            yield self
            return
        opening, closing = (None, None) if self.towards is None else (self.utc_unix_s[0], times[0])
        yield replace(self, turned_utc_unix_s=None, unseen_utc_unix_s=closing)
        directions = turned(self.directions, times - self.utc_unix_s)
        towards = (
            None if self.towards is None else turned(self.towards[None], times[:1] - self.utc_unix_s[:1])[0]
        )
        yield replace(
            self,
            directions=directions,
            utc_unix_s=times,
            turned_utc_unix_s=None,
            towards=towards,
            unseen_utc_unix_s=opening,
        )

    @property
    def axes(self) -> np.ndarray:
        """Unit vectors (E, 2, 3) along growing right ascension and growing declination at each end."""
        return np.stack([enu_at_zenith(d)[:2] for d in self.directions])


def turned(directions: np.ndarray, seconds: np.ndarray) -> np.ndarray:
    """Directions (N, 3), GCRS, that stand still above the ground, as they are `seconds` (N,) later.

    They turn about the axis of GCRS. The Earth's is 0.2 deg from it, which is 0.1 arcsec in 2 s.
    """
    # as what stands still in the sky turns above the ground, the other way
    return later(directions, -seconds)

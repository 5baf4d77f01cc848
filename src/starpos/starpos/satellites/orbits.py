# SPDX-License-Identifier: Apache-2.0
"""Where satellites are seen from the ground: Earth and orbits at the times of trails, and directions among the stars.

A satellite near the Earth does not share the stars' annual aberration, and its light left it while the Earth turned;
compared with the stars' catalogue places (ICRS) it stands where these two leave it (Green 1985, Spherical Astronomy, 8).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from starpos.earth.gravity import SPIN, geodetic_place
from starpos.earth.orientation import SPEED_OF_LIGHT, earth_state, later
from starpos.earth.refraction import MIN_COS_ZENITH, STANDARD_PRESSURE_PA, Atmosphere
from starpos.frozen import at_once
from starpos.rotation import normalised, unit_vector
from starpos.satellites.elements import Orbit, teme_to_gcrs
from starpos.units import DAY_S, UNIX_EPOCH_JD

# height over which the air thins by e
AIR_SCALE_M = 8400.0


@at_once
@dataclass(frozen=True, kw_only=True)
class Moments:
    """The Earth at times (E,), UTC in Unix s.

    gcrs_to_itrs, teme_to_gcrs (E, 3, 3); velocity (E, 3): the Earth's, barycentric, in units of c.
    """

    utc_unix_s: np.ndarray
    gcrs_to_itrs: np.ndarray
    teme_to_gcrs: np.ndarray
    velocity: np.ndarray

    @classmethod
    def at(cls, utc_unix_s: np.ndarray) -> "Moments":
        """Compute each time once; TimeError where the Earth's orientation is unknown."""
        times, index = np.unique(utc_unix_s, return_inverse=True)
        states = [earth_state(float(t)) for t in times]
        columns = (
            np.array([s.gcrs_to_itrs for s in states]),
            np.array([teme_to_gcrs(s) for s in states]),
            np.array([s.velocity for s in states]),
        )
        gcrs_to_itrs, teme, velocity = (column[index.ravel()] for column in columns)
        return cls(utc_unix_s=utc_unix_s, gcrs_to_itrs=gcrs_to_itrs, teme_to_gcrs=teme, velocity=velocity)

    def site(self, place: np.ndarray, seconds: float) -> tuple[np.ndarray, np.ndarray]:
        """GCRS positions and velocities (E, 3) of a place (3,) in ITRS, m, that many seconds after the times."""
        turned = later(np.tile(place, (len(self.utc_unix_s), 1)), np.full(len(self.utc_unix_s), -seconds))
        moving = np.cross(SPIN, turned)
        return tuple(np.einsum("eji,ej->ei", self.gcrs_to_itrs, v) for v in (turned, moving))  # type: ignore[return-value]


def states(orbits: Sequence[Orbit], moments: Moments, seconds: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """GCRS positions and velocities (E, 3), m and m/s, of an orbit for each time, `seconds` (E,) after it; NaN: none."""
    r, v = np.empty((2, len(orbits), 3))
    for k, (orbit, t) in enumerate(zip(orbits, moments.utc_unix_s + seconds, strict=True)):
        if orbit.ephemeris is not None:
            r[k], v[k] = orbit.ephemeris.at(float(t))
            continue
        whole, part = divmod(t / DAY_S, 1.0)
        error, place, velocity = orbit.record.sgp4(UNIX_EPOCH_JD + whole, part)
        turn = moments.teme_to_gcrs[k]
        r[k], v[k] = turn @ place * 1e3, turn @ velocity * 1e3
        if error:
            r[k] = np.nan
    return r, v


def observed(
    r: np.ndarray, v: np.ndarray, site: np.ndarray, earth: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Directions (E, 3) among the stars' catalogue places, and distances (E,) m, of satellites.

    r, v (E, 3): their states, GCRS.  site (E, 3): the observers', m.  earth (E, 3): the Earth's barycentric velocity in
    units of c.
    """
    distance = np.linalg.norm(r - site, axis=-1)
    for _ in range(2):
        d = r - v * (distance / SPEED_OF_LIGHT)[..., None] - site
        distance = np.linalg.norm(d, axis=-1)
    # aberration to first order; the second is 1 mas
    return normalised(d / distance[..., None] - earth), distance


def raised(place: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Heights (E,) m above a place (3,) in ITRS from which satellites seen in directions (E, 3) stand among the stars.

    Air bends the light of something near as much as a star's, but its light enters the air elsewhere. Straight lines in
    the stars' direction pass above the observer: 2.2 m over the square of the cosine of the zenith distance, at sea
    level. They are tangent to the same n r sin(z) as the ray.
    """
    latitude, longitude, height = geodetic_place(place)
    pressure = STANDARD_PRESSURE_PA * np.exp(-np.clip(height, -500.0, 9000.0) / AIR_SCALE_M)
    cosine = np.maximum(directions @ unit_vector(longitude, latitude), MIN_COS_ZENITH)
    bend = Atmosphere(pressure_pa=float(pressure)).refraction()
    return -bend.b * float(np.linalg.norm(place)) / cosine**2


def along_axes(r: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Unit vectors (E, 3, 3), as rows: radial, along the motion, across it to the left as seen from above."""
    radial = normalised(r)
    across = normalised(np.cross(r, v))
    return np.stack([radial, np.cross(across, radial), across], 1)

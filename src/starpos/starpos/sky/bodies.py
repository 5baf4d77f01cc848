# SPDX-License-Identifier: Apache-2.0
"""Where the Sun, the Moon and the planets stand, by ERFA: apparent directions from the Earth's centre, and from a place.

Errors as ERFA states them. Of the Sun, by eraEpv00, they are 0.01 arcsec. Of the Moon, by eraMoon98, 3 arcsec rms, 10 at
most. Of the planets, by eraPlan94, they are the largest differences from DE200 over 1800 to 2050.
"""

from dataclasses import dataclass

import erfa
import numpy as np

from starpos import rotation
from starpos.earth.ellipsoid import EQUATOR_RADIUS_M, ground_m
from starpos.earth.orientation import EarthState, station_velocity
from starpos.frozen import at_once
from starpos.units import ARCSEC

SUN, MOON = "sun", "moon"
# of eraPlan94: its number, the error of its longitude as seen from the Sun (arcsec), the radius at 1 au (arcsec)
PLANETS = {
    "mercury": (1, 4.0, 3.36),
    "venus": (2, 5.0, 8.34),
    "mars": (4, 17.0, 4.68),
    "jupiter": (5, 71.0, 98.44),
    "saturn": (6, 81.0, 82.73),
    "uranus": (7, 86.0, 35.02),
    "neptune": (8, 11.0, 33.50),
}
BODIES = (SUN, MOON, *PLANETS)
SUN_ARCSEC, SUN_RADIUS_ARCSEC = 0.015, 959.63
MOON_ARCSEC, MOON_RADIUS_M = 3.0, 1_737_400.0
LIGHT_DAYS_PER_AU = erfa.AULT / erfa.DAYSEC
# the light time settles to far less than a second
LIGHT_ROUNDS = 3


@at_once
@dataclass(frozen=True)
class Body:
    """A body as it is seen from the Earth's centre at one time.

    itrs (3,): apparent direction, with light time and annual aberration.
    distance_m: from the Earth's centre.  radius: semidiameter from there, rad.  sigma: error of itrs along an axis, rad.
    """

    name: str
    itrs: np.ndarray
    distance_m: float
    radius: float
    sigma: float

    @property
    def parallax(self) -> float:
        """The equatorial horizontal parallax, rad."""
        return EQUATOR_RADIUS_M / self.distance_m

    def from_place(self, zenith: np.ndarray) -> np.ndarray:
        """Direction (3,) in ITRS as it is seen, without refraction, at the place with this zenith (3,) in ITRS."""
        from_there = rotation.normalised(self.itrs - ground_m(zenith) / self.distance_m)
        return rotation.normalised(from_there + station_velocity(zenith))


def body_at(name: str, state: EarthState) -> Body:
    """The body of one of the names in BODIES at the state's time."""
    days, observer, delay = (state.year - 2000.0) * erfa.DJY, state.observer_au, 0.0
    for _ in range(LIGHT_ROUNDS):
        seen = _barycentric_au(name, days - delay) - observer
        distance_au = float(np.linalg.norm(seen))
        delay = distance_au * LIGHT_DAYS_PER_AU
    astrom = state.astrom
    apparent = erfa.ab(seen / distance_au, astrom["v"], astrom["em"], astrom["bm1"])
    distance_m = distance_au * erfa.DAU
    if name == MOON:
        radius, sigma_arcsec = float(np.arcsin(MOON_RADIUS_M / distance_m)), MOON_ARCSEC
    elif name == SUN:
        radius, sigma_arcsec = SUN_RADIUS_ARCSEC * ARCSEC / distance_au, SUN_ARCSEC
    else:
        _, heliocentric_arcsec, radius_arcsec = PLANETS[name]
        from_sun_au = float(np.linalg.norm(seen + observer - _barycentric_au(SUN, days - delay)))
        radius = radius_arcsec * ARCSEC / distance_au
        sigma_arcsec = heliocentric_arcsec * from_sun_au / distance_au
    return Body(name, apparent @ state.gcrs_to_itrs.T, distance_m, radius, float(sigma_arcsec * ARCSEC))


def _barycentric_au(name: str, days: float) -> np.ndarray:
    """Barycentric place (3,), au, along the axes of ICRS; days: of TT after J2000."""
    heliocentric, barycentric = erfa.epv00(erfa.DJ00, days)
    if name == MOON:
        return barycentric["p"] + erfa.moon98(erfa.DJ00, days)["p"]
    sun = barycentric["p"] - heliocentric["p"]
    return sun if name == SUN else sun + erfa.plan94(erfa.DJ00, days, PLANETS[name][0])["p"]

# SPDX-License-Identifier: Apache-2.0
"""Where the Sun, the Moon and the planets stand: apparent directions from the Earth's centre, and from a place.

By ERFA, or by a kernel of JPL's that the user gives (de440s.bsp), which `jplephem` reads. Errors as ERFA states them: of
the Sun, by eraEpv00, they are 0.01 arcsec; of the Moon, by eraMoon98, 3 arcsec rms, 10 at most; of the planets, by
eraPlan94, the largest differences from DE200 over 1800 to 2050.
"""

import io
import struct
from dataclasses import dataclass, field
from typing import Any, Protocol

import erfa
import numpy as np

from starpos import rotation
from starpos.earth.ellipsoid import EQUATOR_RADIUS_M, ground_m
from starpos.earth.orientation import EarthState, station_velocity
from starpos.errors import InstrumentError, TimeError
from starpos.files import bytes_of, open_regular
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


class SolarSystem(Protocol):
    """Barycentric places of the bodies and of the Earth, (3,) au along the axes of ICRS; days: of TT after J2000."""

    def body_au(self, name: str, days: float) -> np.ndarray: ...

    def earth_au(self, days: float) -> np.ndarray: ...

    def error_arcsec(self, name: str, from_sun_au: float, distance_au: float) -> float:
        """1 sigma of the direction along an axis, for a body so far from the Sun and from the Earth."""
        ...


class ErfaEphemeris:
    """ERFA's own series: eraEpv00, eraMoon98, eraPlan94."""

    def body_au(self, name: str, days: float) -> np.ndarray:
        heliocentric, barycentric = erfa.epv00(erfa.DJ00, days)
        if name == MOON:
            return barycentric["p"] + erfa.moon98(erfa.DJ00, days)["p"]
        sun = barycentric["p"] - heliocentric["p"]
        return sun if name == SUN else sun + erfa.plan94(erfa.DJ00, days, PLANETS[name][0])["p"]

    def earth_au(self, days: float) -> np.ndarray:
        return erfa.epv00(erfa.DJ00, days)[1]["p"]

    def error_arcsec(self, name: str, from_sun_au: float, distance_au: float) -> float:
        if name in PLANETS:
            return PLANETS[name][1] * from_sun_au / distance_au
        return MOON_ARCSEC if name == MOON else SUN_ARCSEC


ERFA = ErfaEphemeris()
# NAIF's numbers; of the outer planets the barycentres with their moons, from which they are off by less than 0.1 arcsec
NAIF = {SUN: 10, MOON: 301} | {
    name: number if number > 3 else 100 * number + 99 for name, (number, *_) in PLANETS.items()
}
EARTH, BARYCENTRE, KERNEL_ARCSEC = 399, 0, 0.1
# de440.bsp, the largest one that is usual, has 120 MB
MAX_BYTES = 200_000_000
HOW_TO_READ = "install jplephem (pip install 'starpos[ephemeris]')"


@dataclass(frozen=True)
class JplKernel:
    """A JPL ephemeris in SPICE's format (SPK, .bsp); InstrumentError if it cannot be read, or lacks a body."""

    path: str
    _segments: dict[int, list[Any]] = field(default_factory=dict, compare=False, repr=False)

    def __post_init__(self) -> None:
        try:
            from jplephem.daf import DAF
            from jplephem.spk import SPK
        except ImportError:
            raise InstrumentError(f"{self.path}: to read an ephemeris, {HOW_TO_READ}") from None
        try:
            with open_regular(self.path) as file:
                kernel = SPK(DAF(io.BytesIO(bytes_of(file, MAX_BYTES))))
        except (OSError, ValueError, IndexError, TypeError, KeyError, struct.error) as error:
            raise InstrumentError(
                f"{self.path}: this is no ephemeris in SPICE's format ({error}): give a file like de440s.bsp"
            ) from None
        for segment in kernel.segments:
            self._segments.setdefault(segment.target, []).append(segment)
        if lacking := [
            n for n, number in {**NAIF, "the Earth": EARTH}.items() if number not in self._segments
        ]:
            raise InstrumentError(f"{self.path}: it lacks {', '.join(lacking)}: give a file like de440s.bsp")

    def __reduce__(self) -> tuple:
        return JplKernel, (self.path,)

    def body_au(self, name: str, days: float) -> np.ndarray:
        return self._place_au(NAIF[name], days)

    def earth_au(self, days: float) -> np.ndarray:
        return self._place_au(EARTH, days)

    def error_arcsec(self, name: str, from_sun_au: float, distance_au: float) -> float:
        return SUN_ARCSEC if name in (SUN, MOON) else KERNEL_ARCSEC

    def _place_au(self, target: int, days: float) -> np.ndarray:
        place_km = np.zeros(3)
        while target != BARYCENTRE:
            for segment in self._segments.get(target, ()):
                if segment.start_jd <= erfa.DJ00 + days <= segment.end_jd:
                    break
            else:
                raise TimeError(f"{self.path}: the ephemeris does not hold this date: give one that does")
            place_km = place_km + segment.compute(erfa.DJ00, days)[:3]
            target = segment.center
        return place_km * (1000 / erfa.DAU)


def body_at(name: str, state: EarthState, ephemeris: SolarSystem = ERFA) -> Body:
    """The body of one of the names in BODIES at the state's time."""
    days, delay = (state.year - 2000.0) * erfa.DJY, 0.0
    observer = ephemeris.earth_au(days)
    for _ in range(LIGHT_ROUNDS):
        seen = ephemeris.body_au(name, days - delay) - observer
        distance_au = float(np.linalg.norm(seen))
        delay = distance_au * LIGHT_DAYS_PER_AU
    astrom = state.astrom
    apparent = erfa.ab(seen / distance_au, astrom["v"], astrom["em"], astrom["bm1"])
    distance_m = distance_au * erfa.DAU
    from_sun_au = float(np.linalg.norm(seen + observer - ephemeris.body_au(SUN, days - delay)))
    if name == MOON:
        radius = float(np.arcsin(MOON_RADIUS_M / distance_m))
    else:
        radius = (SUN_RADIUS_ARCSEC if name == SUN else PLANETS[name][2]) * ARCSEC / distance_au
    sigma = ephemeris.error_arcsec(name, from_sun_au, distance_au) * ARCSEC
    return Body(name, apparent @ state.gcrs_to_itrs.T, distance_m, radius, sigma)

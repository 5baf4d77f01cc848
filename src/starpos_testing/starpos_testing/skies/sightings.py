# SPDX-License-Identifier: Apache-2.0
"""A drawn sky of satellites, and trails as an observer at a place sees them, by astropy and formulas of its own."""

from functools import cache

import numpy as np
from astropy import units
from astropy.coordinates import (
    GCRS,
    TEME,
    CartesianRepresentation,
    EarthLocation,
    get_body_barycentric_posvel,
)
from astropy.time import Time

from starpos_testing.skies import orbits

C = 299792.458
NIGHT = 1.6e9
AGE_DAYS = 1.0


def drawn(count: int, seed: int, names: str = "OBJECT"):
    """Records of sgp4 in low orbits, elements of AGE_DAYS before NIGHT, and their text."""
    return orbits.drawn(count, seed, NIGHT - AGE_DAYS * 86400, names)


@cache
def surroundings(latitude_deg: float, longitude_deg: float, height_m: float, utc_unix_s: float):
    """TEME into GCRS (3, 3), the observer (3,) km, and the Earth's velocity (3,) km/s, by astropy."""
    t = Time(utc_unix_s, format="unix", scale="utc")
    axes = TEME(CartesianRepresentation(np.eye(3) * units.km), obstime=t).transform_to(GCRS(obstime=t))
    place = EarthLocation.from_geodetic(longitude_deg, latitude_deg, height_m)
    site = place.get_gcrs_posvel(t)[0].xyz.to_value(units.km)
    earth = get_body_barycentric_posvel("earth", t)[1].xyz.to_value(units.km / units.s)
    return axes.cartesian.xyz.to_value(units.km), site, earth


def sight(record, place: tuple[float, float, float], utc_unix_s: float, ahead_s: float = 0.0):
    """Catalogue direction (3,) and elevation (rad) of a satellite that is `ahead_s` before its elements.

    place: latitude, longitude (deg), height (m).
    """
    axes, site, earth = surroundings(*place, utc_unix_s)

    def at(seconds) -> np.ndarray:
        moment = Time(utc_unix_s + seconds, format="unix", scale="utc")
        return axes @ np.array(record.sgp4(moment.jd1, moment.jd2)[1])

    tau = np.linalg.norm(at(ahead_s) - site) / C
    d = at(ahead_s - tau) - site
    d /= np.linalg.norm(d)
    return unaberrated(d, earth / C), np.arcsin(d @ site / np.linalg.norm(site))


def unaberrated(apparent: np.ndarray, beta: np.ndarray) -> np.ndarray:
    """The direction in which a star stands that a moving observer sees there: the exact formula of special relativity."""
    gamma = 1 / np.sqrt(1 - beta @ beta)
    along = apparent @ beta
    still = apparent / gamma + beta * (gamma / (gamma + 1) * along - 1)
    return still / (1 - along) / np.linalg.norm(still / (1 - along))


def table(records, place, rng, *, count: int, late_s: float = 0.0, along_s=None, stddev_arcsec: float = 3.0):
    """A table of trails of 2 s, of the first satellites that are more than 20 deg high; and the satellites' numbers.

    late_s: UTC minus the stamp.  along_s (N,): by how much each satellite is before its elements.
    """
    rows, numbers = ["track,utc,ra_deg,dec_deg,stddev_arcsec"], list[int]()
    at = NIGHT
    for k, record in enumerate(records):
        ahead = 0.0 if along_s is None else along_s[k]
        if sight(record, place, NIGHT, ahead)[1] < np.radians(20):
            continue
        for end in (at, at + 2):
            v, _ = sight(record, place, end + late_s, ahead)
            v = v + rng.normal(0, stddev_arcsec / 206265, 3)
            ra, dec = np.degrees([np.arctan2(v[1], v[0]), np.arcsin(v[2] / np.linalg.norm(v))])
            utc = Time(end, format="unix", scale="utc").isot
            rows.append(f"{len(numbers)},{utc}Z,{ra % 360:.7f},{dec:.7f},{stddev_arcsec}")
        numbers.append(record.satnum)
        at += 3
        if len(numbers) == count:
            break
    assert len(numbers) == count
    return "\n".join(rows) + "\n", numbers

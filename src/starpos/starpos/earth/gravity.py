# SPDX-License-Identifier: Apache-2.0
"""Normal gravity of WGS 84 as a vector in ITRS (attraction and centrifugal force), and the tide of the plumb line.

Gravity is along the ellipsoid's normal, also above the ellipsoid: a place found by it is astronomic, that where the
ellipsoid's normal is the plumb line.
"""

import erfa
import numpy as np

from starpos.earth.ellipsoid import ECCENTRICITY2, EQUATOR_RADIUS_M, enu_axes
from starpos.earth.orientation import ROTATION_RAD_S, TT_MINUS_UTC_S, earth_state
from starpos.earth.vertical import SOMIGLIANA_K
from starpos.rotation import unit_vector
from starpos.units import DAY_S, UNIX_EPOCH_JD

# NIMA TR8350.2, tables 3.1 and 3.4: gravity at the equator, flattening, and its ratio m of forces
EQUATOR_GRAVITY, FLATTENING, FORCES_RATIO = 9.7803253359, 1 / 298.257223563, 0.00344978650684
SPIN = np.array([0.0, 0.0, ROTATION_RAD_S])
# ERFA's number of the ellipsoid.
WGS84 = 1


def geodetic_place(place: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Latitude, longitude (rad) and height (m), (...) each, of places (..., 3) in ITRS, m."""
    longitude, latitude, height = erfa.gc2gd(WGS84, place)
    return latitude, longitude, height


def itrs_place(latitude: float, longitude: float, height_m: float) -> np.ndarray:
    """Place (3,) in ITRS, m, of geodetic coordinates in rad and m."""
    return np.asarray(erfa.gd2gc(WGS84, longitude, latitude, height_m))


def zenith_at(place: np.ndarray) -> np.ndarray:
    """Unit vectors (..., 3) that point up at places (..., 3) in ITRS, m."""
    latitude, longitude, _ = geodetic_place(place)
    return unit_vector(longitude, latitude)


def enu_at(place: np.ndarray) -> np.ndarray:
    """East, north, up (3, 3), as rows, by the ellipsoid at a place (3,) in ITRS, m."""
    latitude, longitude, _ = geodetic_place(place)
    return enu_axes(float(latitude), float(longitude))


def gravity(place: np.ndarray) -> np.ndarray:
    """Gravity (..., 3), m/s2, at places (..., 3) in ITRS, m: Somigliana's formula with two terms of height (TR8350.2)."""
    latitude, longitude, height = geodetic_place(place)
    return -_strength(latitude, height)[..., None] * unit_vector(longitude, latitude)


def gravity_gradient(place: np.ndarray) -> np.ndarray:
    """Derivatives (..., 3, 3) of gravity by the place, 1/s2; good to 1 %, as adjustments need them."""
    latitude, longitude, height = geodetic_place(place)
    up, strength = unit_vector(longitude, latitude), _strength(latitude, height)
    across = -(strength / (EQUATOR_RADIUS_M + height))[..., None, None]
    along = up[..., :, None] * up[..., None, :]
    return across * (np.eye(3) - 3 * along)


def _strength(latitude: np.ndarray, height: np.ndarray) -> np.ndarray:
    sin2 = np.sin(latitude) ** 2
    below = EQUATOR_GRAVITY * (1 + SOMIGLIANA_K * sin2) / np.sqrt(1 - ECCENTRICITY2 * sin2)
    share = height / EQUATOR_RADIUS_M
    return below * (1 - 2 * (1 + FLATTENING + FORCES_RATIO - 2 * FLATTENING * sin2) * share + 3 * share**2)


# m3/s2: IERS Conventions (2010), table 1.1 (Sun, and the Moon by its mass ratio to the Earth).
GM_SUN, GM_MOON = 1.32712442099e20, 3.986004418e14 * 0.0123000371
# Degree-2 Love and Shida numbers: IERS Conventions (2010), table 6.3 (k, elastic Earth) and section 7.1.1 (l).
K2, L2 = 0.29525, 0.0847
# The plumb line among the stars over a mark whose coordinates are without the tide: the Earth's bulge pulls too, and the
# mark moves (Melchior, The Tides of the Planet Earth (1983), chapter 1: Lambda = 1 + k - l).
YIELDING = 1 + K2 - L2


def plumb_tide(utc_unix_s: float, place: np.ndarray, enu: np.ndarray) -> np.ndarray:
    """Lean (2,) of up by the tide, to the east and to the north, rad.

    place (3,) in ITRS, m; enu (3, 3): rotation of ITRS into east, north, up.  Tide free: the mean tide is in it.
    TimeError outside the tables of the Earth's rotation.
    """
    pull = tidal_pull(utc_unix_s, place)
    return -YIELDING * (enu[:2] @ pull) / np.linalg.norm(gravity(place))


def tidal_pull(utc_unix_s: float, place: np.ndarray) -> np.ndarray:
    """Attraction (3,) of Moon and Sun at a place in ITRS, m, less that at the Earth's centre, m/s2, ITRS."""
    tt = UNIX_EPOCH_JD, (utc_unix_s + TT_MINUS_UTC_S) / DAY_S
    to_itrs = earth_state(utc_unix_s).gcrs_to_itrs
    moon = np.asarray(erfa.moon98(*tt)["p"])
    # TT serves as TDB: they differ by 2 ms
    sun = -np.asarray(erfa.epv00(*tt)[0]["p"])
    of_moon = _differential(GM_MOON, to_itrs @ moon * erfa.DAU, place)
    return of_moon + _differential(GM_SUN, to_itrs @ sun * erfa.DAU, place)


def _differential(strength: float, body: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Attraction (3,) by a body (3,) at a place (3,) less that at the origin."""
    apart = body - place
    return strength * (apart / np.linalg.norm(apart) ** 3 - body / np.linalg.norm(body) ** 3)

# SPDX-License-Identifier: Apache-2.0
"""The tide of the plumb line: the pull of Moon and Sun on it, and the yielding of the solid Earth."""

import erfa
import numpy as np

from starpos.earth.gravity import gravity
from starpos.earth.orientation import TT_MINUS_UTC_S, earth_state
from starpos.units import DAY_S
from starpos.utc import UNIX_EPOCH_JD

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

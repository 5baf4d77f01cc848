# SPDX-License-Identifier: Apache-2.0
"""Normal gravity of WGS 84 as a vector in ITRS: attraction and centrifugal force, along the ellipsoid's normal.

Along the normal also above the ellipsoid: a place found by it is astronomic, that where the ellipsoid's normal is the
plumb line.
"""

import erfa
import numpy as np

from starpos.earth.ellipsoid import ECCENTRICITY2, EQUATOR_RADIUS_M
from starpos.earth.orientation import ROTATION_RAD_S
from starpos.earth.vertical import SOMIGLIANA_K
from starpos.rotation import unit_vector

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

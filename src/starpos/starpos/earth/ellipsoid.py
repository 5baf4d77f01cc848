# SPDX-License-Identifier: Apache-2.0
"""The figure of the Earth: WGS 84, its radii of curvature, and the direction of up."""

import math

import numpy as np

from starpos.rotation import unit_vector

# WGS 84.
EQUATOR_RADIUS_M, ECCENTRICITY2 = 6378137.0, 6.69437999014e-3
# The mean radius, for errors in metres.
EARTH_RADIUS_M = 6.371e6
# Tangent of the latitude 6 m from a pole; closer, the heading is not known in any case.
STEEPEST = 1e6


def zenith_of(latitude: float, longitude: float) -> np.ndarray:
    """Unit vector (3,) in ITRS that points up at a latitude and longitude (rad)."""
    return unit_vector(longitude, latitude)


def ground_m(zenith: np.ndarray) -> np.ndarray:
    """The place (3,) on the ellipsoid whose zenith is (3,) in ITRS, from the Earth's centre, m."""
    prime = EQUATOR_RADIUS_M / math.sqrt(1 - ECCENTRICITY2 * zenith[2] ** 2)
    return prime * np.array([zenith[0], zenith[1], (1 - ECCENTRICITY2) * zenith[2]])


def place_of_zenith(zenith: np.ndarray) -> tuple[float, float]:
    """Latitude, longitude (rad) at which the unit vector (3,) in ITRS points up; the longitude at a pole is 0."""
    x, y, z = np.asarray(zenith, float).tolist()
    return math.atan2(z, math.hypot(x, y)), math.atan2(y, x)


def enu_axes(latitude: float, longitude: float) -> np.ndarray:
    """Rotation (3, 3) of ITRS into east, north, up at a place (rad); at a pole its longitude defines north."""
    cl, sl, cp, sp = np.cos(longitude), np.sin(longitude), np.cos(latitude), np.sin(latitude)
    return np.array([[-sl, cl, 0.0], [-sp * cl, -sp * sl, cp], [cp * cl, cp * sl, sp]])


def enu_at_zenith(zenith: np.ndarray) -> np.ndarray:
    """East, north, up (3, 3), as rows, where a vector (3,) points up: of a star, also along growing coordinates."""
    return enu_axes(*place_of_zenith(zenith))


def meridian_turn(latitude: float) -> float:
    """Turn (rad) of north on the way of 1 rad to the east, tan(latitude), up to STEEPEST; finite at a pole."""
    return min(max(math.tan(latitude), -STEEPEST), STEEPEST)


def curvature_radii_m(latitude: float) -> tuple[float, float]:
    """Radii of curvature of WGS 84 (prime vertical, meridian) in m at a latitude in rad."""
    w2 = 1 - ECCENTRICITY2 * np.sin(latitude) ** 2
    return EQUATOR_RADIUS_M / np.sqrt(w2), EQUATOR_RADIUS_M * (1 - ECCENTRICITY2) / w2**1.5

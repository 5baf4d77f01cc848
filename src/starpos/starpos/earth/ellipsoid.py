# SPDX-License-Identifier: Apache-2.0
"""The figure of the Earth: WGS 84, its radii of curvature, and the direction of up."""

import numpy as np

from starpos.rotation import unit_vector

EQUATOR_RADIUS_M, ECCENTRICITY2 = 6378137.0, 6.69437999014e-3  # WGS 84
EARTH_RADIUS_M = 6.371e6  # mean radius, for errors in metres


def zenith_of(latitude: float, longitude: float) -> np.ndarray:
    """Unit vector (3,) in ITRS that points up at a latitude and longitude (rad)."""
    return unit_vector(longitude, latitude)


def curvature_radii_m(latitude: float) -> tuple[float, float]:
    """Radii of curvature of WGS 84 (prime vertical, meridian) in m at a latitude in rad."""
    w2 = 1 - ECCENTRICITY2 * np.sin(latitude) ** 2
    return EQUATOR_RADIUS_M / np.sqrt(w2), EQUATOR_RADIUS_M * (1 - ECCENTRICITY2) / w2**1.5

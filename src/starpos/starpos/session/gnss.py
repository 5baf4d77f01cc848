# SPDX-License-Identifier: Apache-2.0
"""Satellites' place beside the stars': compared, never fused, so that either can tell of the other that it is wrong."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from starpos.earth.ellipsoid import curvature_radii_m
from starpos.earth.vertical import Geodetic
from starpos.messages.stamp import stamp_to_unix
from starpos.rotation import half_turn

# of a fix that states no error, m an axis
UNSTATED_M = 30.0
# places that differ by more sigmas are not the same
SIGMAS = 5.0
# an older one says nothing of now, s
OLDEST_S = 5.0


@dataclass(frozen=True, eq=False, kw_only=True)
class GnssPlace:
    """Latitude and longitude on WGS 84 (rad), and the covariance (2, 2) of east and north, m2."""

    utc_unix_s: float
    latitude: float
    longitude: float
    covariance: np.ndarray


def message_to_gnss(message: Any) -> GnssPlace | None:
    """The place of a sensor_msgs/NavSatFix, None where it has none."""
    place = np.radians([message.latitude, message.longitude])
    unix_s = stamp_to_unix(message.header.stamp)
    if message.status.status < 0 or unix_s is None or not np.isfinite(place).all():
        return None
    covariance = np.reshape(message.position_covariance, (3, 3))[:2, :2]
    stated = np.isfinite(covariance).all() and np.linalg.eigvalsh(covariance)[0] > 0
    if message.position_covariance_type == 0 or not stated:
        covariance = np.eye(2) * UNSTATED_M**2
    return GnssPlace(
        utc_unix_s=unix_s,
        latitude=float(place[0]),
        longitude=float(place[1]),
        covariance=np.array(covariance, float),
    )


def contradiction(gnss: GnssPlace, ground: Geodetic, utc_unix_s: float, speed: float) -> tuple[float, str]:
    """How far GNSS's place lies from ours of a time, m, and a sentence where the two cannot both be right.

    speed: of the vehicle, m/s, which goes on between the two times.
    """
    prime, meridian = curvature_radii_m(ground.latitude)
    east = half_turn(gnss.longitude - ground.longitude)
    off = np.array([east * prime * np.cos(ground.latitude), (gnss.latitude - ground.latitude) * meridian])
    on_the_way = speed * (utc_unix_s - gnss.utc_unix_s)
    claim = ground.covariance[:2, :2] + gnss.covariance + np.eye(2) * on_the_way**2
    apart, sigmas = float(np.linalg.norm(off)), float(np.sqrt(off @ np.linalg.solve(claim, off)))
    if sigmas < SIGMAS:
        return apart, ""
    return apart, (
        f"GNSS has a place {apart:.3g} m from here, {sigmas:.2g} times what both claim: one of them is wrong"
    )

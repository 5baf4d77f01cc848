# SPDX-License-Identifier: Apache-2.0
"""Place, heading and velocity at one time of a voyage, as people and other programs want them."""

from dataclasses import dataclass

import numpy as np

from starpos.earth.ellipsoid import curvature_radii_m, enu_axes, meridian_turn
from starpos.earth.gravity import geodetic_place
from starpos.earth.orientation import earth_state
from starpos.fix.budget import heading_of, heading_row, time_terms, total_covariance
from starpos.navigation.motion import PLACE, TURN, VELOCITY, Motion


@dataclass(frozen=True, kw_only=True)
class TimeErrors:
    """Errors of time that all fixes share, 1 sigma: of the clock against UTC, and of the frames' stamps; s."""

    clock_s: float
    stamp_s: float


@dataclass(frozen=True, eq=False, kw_only=True)
class VoyageFix:
    """Astronomic latitude, longitude and heading of the body's x (rad) at one time of a voyage.

    covariance (3, 3): east m, north m, heading rad.  velocity (3,): east, north, up, m/s; velocity_covariance (3, 3).
    link_to_enu (3, 3): the body's axes, x forward, into east, north, up; attitude_covariance (3, 3): rad2, about these.
    gyro_bias, accel_bias (3,): rad/s, m/s2.
    """

    utc_unix_s: float
    latitude: float
    longitude: float
    heading: float
    covariance: np.ndarray
    velocity: np.ndarray
    velocity_covariance: np.ndarray
    link_to_enu: np.ndarray
    attitude_covariance: np.ndarray
    gyro_bias: np.ndarray
    accel_bias: np.ndarray


def fix_of(motion: Motion, k: int, covariance: np.ndarray, errors: TimeErrors) -> VoyageFix:
    """The fix at node k, of whose unknowns this is the covariance; the errors of time and Earth rotation are added."""
    latitude, longitude, _ = (float(x) for x in geodetic_place(motion.place[k]))
    enu, (prime, meridian) = enu_axes(latitude, longitude), curvature_radii_m(latitude)
    attitude = enu @ motion.attitude[k]
    # turns of east, north, up about themselves for a metre to the east and to the north
    carried = np.array([[0, -1 / meridian], [1 / prime, 0], [meridian_turn(latitude) / prime, 0]])
    # east m, north m, and the small rotation of the attitude about east, north, up
    slope = np.zeros((5, 6))
    slope[:2, :3] = enu[:2]
    slope[2:, :3] = -carried @ enu[:2]
    slope[2:, 3:] = enu
    columns = np.r_[PLACE, TURN]
    place_and_turn = slope @ covariance[np.ix_(columns, columns)] @ slope.T
    to_heading = np.zeros((3, 5))
    to_heading[:2, :2] = np.eye(2)
    to_heading[2:, 2:] = heading_row(attitude)
    earth = earth_state(float(motion.utc_unix_s[k]))
    shared = total_covariance(time_terms(latitude, earth, errors.clock_s, errors.stamp_s))
    return VoyageFix(
        utc_unix_s=float(motion.utc_unix_s[k]),
        latitude=latitude,
        longitude=longitude,
        heading=heading_of(attitude),
        covariance=to_heading @ place_and_turn @ to_heading.T + shared[:3, :3],
        velocity=enu @ motion.velocity[k],
        velocity_covariance=enu @ covariance[VELOCITY, VELOCITY] @ enu.T,
        link_to_enu=attitude,
        attitude_covariance=place_and_turn[2:, 2:] + shared[3:, 3:],
        gyro_bias=motion.gyro_bias[k],
        accel_bias=motion.accel_bias[k],
    )

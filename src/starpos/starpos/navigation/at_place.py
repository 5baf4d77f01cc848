# SPDX-License-Identifier: Apache-2.0
"""Heading, pitch and roll of a vehicle at a known place, from one frame's attitude: before its own place is known."""

import math
from dataclasses import dataclass

import numpy as np

from starpos import rotation
from starpos.earth.ellipsoid import meridian_turn
from starpos.earth.known_place import KnownPlace
from starpos.earth.orientation import ROTATION_RAD_S, earth_orientation
from starpos.navigation.placeless import PlacelessFrame
from starpos.navigation.vessel import Vessel


@dataclass(frozen=True, eq=False, kw_only=True)
class BodyAttitude:
    """The body's axes, x forward, in east, north, up: level by the plumb line, north by WGS 84.

    link_to_enu (3, 3); attitude_covariance (3, 3): rad2, of its small rotation about east, north, up.
    """

    utc_unix_s: float
    link_to_enu: np.ndarray
    attitude_covariance: np.ndarray


def attitude_at_place(frame: PlacelessFrame, place: KnownPlace, vessel: Vessel) -> BodyAttitude:
    """The attitude of the body at a known place, with the errors of stars, air, time, place, deflection and mount."""
    a4, air = place.plumb_axes, vessel.atmosphere
    seen = frame.under(a4[2], air)
    g = a4 @ seen.camera_to_itrs
    late_s = [frame.stamp_stddev_s, vessel.clock_stddev_s, earth_orientation(frame.utc_unix_s).ut1_sigma_s]
    # a zenith further east, or north, turns level and north
    level = np.array([[0.0, 1.0], [-1.0, 0.0]])
    north = -meridian_turn(place.plumb[0]) * np.array([[1.0, 0.0]])
    deflection = np.vstack([level * place.plumb_stddev, north * place.ellipsoid_stddev])
    columns = np.column_stack([
        g @ seen.by_refraction * air.relative_sigma,
        a4[:, 2] * ROTATION_RAD_S * math.hypot(*late_s),
        np.vstack([level, north]) @ place.zenith_root,
        deflection,
    ])  # fmt: skip
    to_ellipsoid = place.ellipsoid_axes @ a4.T
    turn = rotation.about_axis(2, -math.atan2(to_ellipsoid[0, 1], to_ellipsoid[1, 1]))
    return BodyAttitude(
        utc_unix_s=frame.utc_unix_s,
        link_to_enu=turn @ g @ vessel.camera_to_body.T,
        attitude_covariance=g @ seen.covariance @ g.T
        + columns @ columns.T
        + np.eye(3) * vessel.mount_stddev**2,
    )

# SPDX-License-Identifier: Apache-2.0
"""Messages of a solution: NavSatFix, Imu, Solution."""

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from sensor_msgs.msg import Imu, NavSatFix, NavSatStatus
from std_msgs.msg import Header

from starpos import rotation
from starpos.earth.vertical import Geodetic
from starpos.fix.attitude import ENU, Attitude
from starpos.fix.fix import Fix
from starpos.fix.heading import AttitudeAtPlace
from starpos.fix.solution import Solution, Status
from starpos.gnss.watch import GnssCheck, GnssStatus
from starpos_common.messages import quaternion, tilt_to_message
from starpos_interfaces import msg

if TYPE_CHECKING:
    from starpos.satellites.locating import SatelliteFix

# the messages name their constants as the enums do
STATUS = {status: getattr(msg.Solution, status.name) for status in Status}
GNSS_STATUS = {status: getattr(msg.GnssCheck, status.name) for status in GnssStatus}
# An entry of the error budget that concerns the geodetic position only.
DEFLECTION = "deflection"
# m2; with a NaN consumers would drop the whole matrix.
UNKNOWN_ALTITUDE_VARIANCE = 1e8
NAN = math.nan
# fields of a Solution that are NaN where they are not known
NUMBERS = [
    name for name, kind in msg.Solution.get_fields_and_field_types().items() if kind.startswith("double")
]


def nav_sat_fix(header: Header, ground: Geodetic | None, values: Mapping[str, Any]) -> NavSatFix:
    """Make a NavSatFix on WGS 84; without a position NO_FIX with NaN, so that consumers see the instrument at work.

    values: the node's parameters, of which altitude and altitude_stddev are the height.
    """
    altitude, covariance = values["altitude"], np.zeros((3, 3))
    if ground is not None:
        covariance[:2, :2] = ground.covariance[:2, :2]
        covariance[2, 2] = (
            UNKNOWN_ALTITUDE_VARIANCE if math.isnan(altitude) else values["altitude_stddev"] ** 2
        )
    return _nav_sat_fix(header, ground, altitude, covariance)


def fix_by_satellites(header: Header, fix: "SatelliteFix | None") -> NavSatFix:
    """Make a NavSatFix on WGS 84 with its height, of satellites among the stars; without a place NO_FIX with NaN."""
    height_m, covariance = (NAN, np.zeros((3, 3))) if fix is None else (fix.height_m, fix.covariance)
    return _nav_sat_fix(header, fix, height_m, covariance)


def _nav_sat_fix(
    header: Header, place: "Geodetic | SatelliteFix | None", altitude: float, covariance: np.ndarray
) -> NavSatFix:
    message = NavSatFix(header=header)
    # no navigation satellites
    message.status.service = 0
    if place is None:
        message.status.status = NavSatStatus.STATUS_NO_FIX
        message.latitude = message.longitude = message.altitude = NAN
        message.position_covariance_type = NavSatFix.COVARIANCE_TYPE_UNKNOWN
        return message
    message.status.status = NavSatStatus.STATUS_FIX
    message.latitude, message.longitude = math.degrees(place.latitude), math.degrees(place.longitude)
    message.altitude = altitude
    message.position_covariance = covariance.ravel()
    message.position_covariance_type = NavSatFix.COVARIANCE_TYPE_KNOWN
    return message


def true_north(link: Attitude, ground: Geodetic) -> Attitude:
    """The attitude of the base link in true-north ENU; `link`: by astronomic north."""
    # Azimuths grow clockwise.
    to_geodetic_north = rotation.about_axis(2, -ground.azimuth_turn)
    turned = link.then(to_geodetic_north, ENU)
    covariance = turned.covariance.copy()
    covariance[2, 2] += ground.deflection_covariance[2, 2]
    return replace(turned, covariance=covariance)


def imu(header: Header, link: Attitude) -> Imu:
    """Make the attitude of the base link in true-north ENU; rates and accelerations are not measured."""
    message = Imu(header=header, orientation=quaternion(link.rotation))
    message.orientation_covariance = link.covariance.ravel()
    message.angular_velocity_covariance[0] = -1.0
    message.linear_acceleration_covariance[0] = -1.0
    return message


def solution(header: Header, answer: Solution, ground: Geodetic | None) -> msg.Solution:
    """Make the Solution message with everything known about one frame."""
    message = msg.Solution(header=header, status=STATUS[answer.status], status_text=answer.message)
    for name in NUMBERS:
        setattr(message, name, [NAN] * 9 if name.startswith("covariance") else NAN)
    message.stars_detected, message.stars_matched = answer.stars_detected, len(answer.names)
    message.ids, message.warnings = list(answer.names), list(answer.warnings)
    message.indices = [] if answer.star is None else answer.star.tolist()
    message.magnitudes = [] if answer.magnitudes is None else answer.magnitudes.tolist()
    message.identify_seconds, message.fix_seconds = answer.identify_s, answer.fix_s
    if (a := answer.pointing) is not None:
        angles = (math.degrees(v) for v in (a.ra, a.dec, a.roll))
        message.right_ascension, message.declination, message.roll = angles
        message.focal_px, message.log_odds, message.mirrored = a.focal_px, a.log_odds, bool(a.mirrored)
        message.residual = a.residual_arcsec
    if answer.tilt:
        message.tilt = tilt_to_message(answer.tilt, "")
        message.tilt_samples = answer.tilt.samples
    else:
        message.tilt.z = message.tilt.z_variance = NAN
    fix, at_place = answer.fix, answer.at_place
    if fix is not None and ground is not None:
        _add_fix(message, fix, ground)
    elif at_place is not None:
        _add_corrections(message, at_place)
        deflection = at_place.place.deflection
        message.xi, message.eta = deflection.xi_arcsec, deflection.eta_arcsec
        for term in at_place.true_north.terms:
            heading = math.degrees(math.sqrt(term.covariance[2, 2]))
            message.budget.append(
                msg.ErrorTerm(name=term.name, east=NAN, north=NAN, heading=heading, common=term.common)
            )
    if at_place is not None:
        link = at_place.true_north
        message.heading = math.degrees(link.heading)
        message.heading_stddev = math.degrees(math.sqrt(link.angles_covariance[0, 0]))
    return message


def _add_fix(message: msg.Solution, fix: Fix, ground: Geodetic) -> None:
    degrees = np.array([1.0, 1.0, np.degrees(1.0)])
    message.residual = fix.residual_arcsec
    message.latitude, message.longitude = math.degrees(fix.latitude), math.degrees(fix.longitude)
    message.latitude_geodetic = math.degrees(ground.latitude)
    message.longitude_geodetic = math.degrees(ground.longitude)
    message.xi, message.eta = ground.deflection.xi_arcsec, ground.deflection.eta_arcsec
    message.heading = math.degrees(ground.heading)
    message.covariance = (fix.covariance * np.outer(degrees, degrees)).ravel()
    message.covariance_geodetic = (ground.covariance * np.outer(degrees, degrees)).ravel()
    message.heading_stddev = math.sqrt(message.covariance_geodetic[8])
    sources = [(t.name, t.covariance[:3, :3], t.common) for t in fix.terms]
    sources.append((DEFLECTION, ground.deflection_covariance, True))
    for name, covariance, common in sources:
        east, north, heading = (np.sqrt(np.maximum(np.diag(covariance), 0.0)) * degrees).tolist()
        message.budget.append(
            msg.ErrorTerm(name=name, east=east, north=north, heading=heading, common=common)
        )
    _add_corrections(message, fix)


def gnss_check(header: Header, check: GnssCheck) -> msg.GnssCheck:
    """Make the message of the comparison of a GNSS place with the stars."""
    return msg.GnssCheck(
        header=header,
        status=GNSS_STATUS[check.status],
        status_text=check.sentence,
        distance=check.distance_m,
        bearing=check.bearing_deg,
        distance_stddev=check.sigma_m,
        latitude=math.degrees(check.place.latitude),
        longitude=math.degrees(check.place.longitude),
        frames=check.frames,
        poses=check.poses,
    )


def _add_corrections(message: msg.Solution, applied: Fix | AttitudeAtPlace) -> None:
    message.refraction = applied.refraction_arcsec
    message.diurnal_aberration = applied.diurnal_aberration_arcsec
    message.ut1_minus_utc = applied.ut1_minus_utc_s

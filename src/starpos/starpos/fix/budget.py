# SPDX-License-Identifier: Apache-2.0
"""The error budget of a fix: the effect of each source of error on place, heading and attitude."""

import math
from dataclasses import dataclass
from functools import partial

import numpy as np

from starpos._numeric.roots import symmetric_root
from starpos.earth.ellipsoid import curvature_radii_m, enu_axes, meridian_turn, place_of_zenith
from starpos.earth.orientation import ROTATION_RAD_S, EarthState
from starpos.earth.refraction import Atmosphere
from starpos.fix.attitude import ENU, LINK, Attitude, heading_row
from starpos.fix.terms import ALWAYS, EACH_POSE, ErrorTerm, Origin, total_covariance
from starpos.frames.exposure import GLOBAL_SHUTTER, Shutter
from starpos.frozen import at_once
from starpos.instrument.camera import Camera
from starpos.instrument.inclinometer import Tilt
from starpos.instrument.instrument import Calibration, Instrument, LocalLevel
from starpos.units import ARCSEC, HOUR_S

# Name of the term of the calibrated A3.
CALIBRATION = "calibration"


@at_once
@dataclass(frozen=True)
class LocalNorth:
    """The place that A4 contains: latitude, longitude (rad); local_to_enu (3, 3): rotation of L into east, north, up."""

    latitude: float
    longitude: float
    local_to_enu: np.ndarray


def local_north(a4: np.ndarray) -> LocalNorth:
    """Place from A4 (3, 3), which takes ITRS into L.  At a pole longitude is 0 and north points along it."""
    latitude, longitude = place_of_zenith(a4[2])
    x, y, _ = (a4 @ enu_axes(latitude, longitude)[1]).tolist()
    level = math.hypot(x, y)
    c, s = y / level, x / level
    return LocalNorth(latitude, longitude, np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]))


@at_once
@dataclass(frozen=True, kw_only=True)
class Circumstances:
    """How a frame was taken: all that its fix takes besides what the frame and its level show.

    instrument: how camera, level and base link are mounted.  earth: when the row was exposed that is read first.
    clock_stddev_s, stamp_stddev_s: of the clock, and of the frame's time stamp by that clock.
    shutter: when each row was exposed.
    axis_stddev: error of the camera's optical axis, rad.
    """

    camera: Camera
    instrument: Instrument
    atmosphere: Atmosphere
    earth: EarthState
    clock_stddev_s: float
    stamp_stddev_s: float = 0.0
    shutter: Shutter = GLOBAL_SHUTTER
    axis_stddev: float = 0.0


def sky_rows(place: LocalNorth) -> np.ndarray:
    """Change (6, 3) of the rows of an ErrorTerm for small rotations of the sky about L's axes, which change A4 only."""
    prime, meridian = curvature_radii_m(place.latitude)
    east, north, _ = place.local_to_enu
    rows = np.zeros((6, 3))
    # a rotation by (dx, dy) moves the zenith among the stars by (-dy, dx)
    rows[0, 0], rows[0, 1] = prime * east[1], -prime * east[0]
    rows[1, 0], rows[1, 1] = meridian * north[1], -meridian * north[0]
    # when the pole moves, north turns in L, and the attitude turns the other way against north
    rows[5] = meridian_turn(place.latitude) * north
    rows[5, 2] -= 1.0
    rows[2] = -rows[5]
    return rows


def level_rows(place: LocalNorth, link_to_enu: np.ndarray) -> np.ndarray:
    """Change (6, 3) of the rows of an ErrorTerm for small rotations of L against sky and instrument.

    They change A4 and the attitude link_to_enu (3, 3) together.
    """
    rows = sky_rows(place)
    rows[3:] += place.local_to_enu
    rows[2] = heading_row(link_to_enu) @ rows[3:]
    return rows


def link_attitude(link_to_enu: np.ndarray, terms: tuple[ErrorTerm, ...]) -> Attitude:
    """The attitude of the base link in east, north, up, with its budget."""
    return Attitude(link_to_enu, total_covariance(terms)[3:, 3:], of=LINK, into=ENU, terms=terms)


def mount_term(link_to_enu: np.ndarray, instrument: Instrument) -> tuple[ErrorTerm, ...]:
    """The error of the base link against the sky that the camera sees; empty if it is 0."""
    if not instrument.mount_stddev_arcsec:
        return ()
    rows = np.vstack([np.zeros((2, 3)), heading_row(link_to_enu), np.eye(3)])
    return (ErrorTerm("mount", rows * (instrument.mount_stddev_arcsec * ARCSEC), shared=ALWAYS),)


def tilt_terms(
    rows: np.ndarray, level: LocalLevel, tilt: Tilt, instrument: Instrument, utc_unix_s: float
) -> tuple[ErrorTerm, ...]:
    """The terms of A3, then of the inclinometer; rows (n, 3): the factors' rows for a small rotation of L.

    None of them has Origin.OTHER: GNSS would count it twice.
    """
    c, calibration, by_axes = instrument.calibration, np.empty((3, 4)), rows @ level.turns
    np.matmul(level.a2, c.covariance_root, out=calibration[:, :3])
    calibration[:, 3] = _turn_error(level, c)
    of_a3 = partial(ErrorTerm, shared=ALWAYS, constant_within_pose=True, origin=Origin.A3)
    return (
        of_a3(CALIBRATION, rows @ calibration),
        of_a3("remounting", rows @ level.a2 * (c.remounted_arcsec * ARCSEC)),
        *_inclinometer_terms(by_axes @ tilt.slope, tilt, instrument, utc_unix_s),
        ErrorTerm(
            "tilt response",
            by_axes @ level.response,
            shared=ALWAYS,
            constant_within_pose=True,
            origin=Origin.INCLINOMETER,
        ),
    )


def sky_terms(
    rows: np.ndarray, earth: EarthState, clock_stddev_s: float, stamp_stddev_s: float, a4: np.ndarray
) -> tuple[ErrorTerm, ...]:
    """The terms of the Earth's rotation, which are the same for all directions.

    rows (n, 3): the factors' rows for a small rotation of the sky about the axes into which a4 (3, 3) takes ITRS.
    """
    # a second of time turns the sky about the pole; the pole itself errs about the two axes across
    second = ROTATION_RAD_S * (rows @ a4[:, 2:])
    orientation = earth.orientation
    return (
        ErrorTerm("clock", second * clock_stddev_s, shared=ALWAYS),
        # a constant lag does not average away and cannot be excluded
        ErrorTerm("time stamp", second * stamp_stddev_s, shared=ALWAYS),
        ErrorTerm("ut1", second * orientation.ut1_sigma_s, shared=ALWAYS),
        ErrorTerm("pole", rows @ a4[:, :2] * orientation.pole_sigma, shared=ALWAYS),
    )


def time_terms(
    latitude: float, earth: EarthState, clock_stddev_s: float, stamp_stddev_s: float
) -> tuple[ErrorTerm, ...]:
    """The terms of the Earth's rotation of any fix at a latitude."""
    axes = enu_axes(latitude, 0.0)
    return sky_terms(sky_rows(local_north(axes)), earth, clock_stddev_s, stamp_stddev_s, axes)


def _turn_error(level: LocalLevel, c: Calibration) -> np.ndarray:
    """Second-order error (3,) of L, as a small rotation about its axes, from A3's error about the plumb line.

    The lean is the change of the tilt since the calibration. If A3 is off by an angle about the plumb line, the lean is
    turned by that angle. To first order this shifts it sideways, which the calibration's own covariance covers. To second
    order it shortens the lean by the angle's cosine: that part is here.
    """
    then = c.up
    variance = then @ c.covariance @ then + (c.remounted_arcsec * ARCSEC) ** 2
    # the mean of (1 - cos)^2 over a Gaussian angle of this variance
    shorter2 = 1.5 - 2 * math.exp(-variance / 2) + math.exp(-2 * variance) / 2
    return level.turns @ (level.up - then) * math.sqrt(max(shorter2, 0.0))


def _inclinometer_terms(
    rows: np.ndarray, tilt: Tilt, instrument: Instrument, utc_unix_s: float
) -> tuple[ErrorTerm, ...]:
    """The inclinometer's terms; rows (n, axes): an ErrorTerm's rows for an error of each angle.

    Its zero is not among them: the calibration's covariance includes it.
    """
    errors, c = instrument.inclinometer, instrument.calibration
    term = partial(ErrorTerm, origin=Origin.INCLINOMETER)
    since_s = abs(utc_unix_s - c.utc_unix_s)
    warmer_c = c.warmer_c(tilt)
    return (
        ErrorTerm("tilt", rows @ symmetric_root(tilt.noise), shared=tilt.times, origin=Origin.READINGS),
        term("tilt quantisation", rows * errors.undithered_rad(tilt), shared=errors.steps(tilt)),
        term("tilt pose", rows * errors.pose_rad, shared=EACH_POSE),
        term(
            "tilt drift",
            rows * errors.drift_rad_per_sqrt_hour / math.sqrt(HOUR_S),
            shared=ALWAYS,
            variance=since_s if math.isfinite(since_s) else 0.0,
            walk_s=1.0,
            constant_within_pose=True,
        ),
        term(
            "tilt temperature",
            rows * errors.temperature_rad_per_c * (warmer_c if math.isfinite(warmer_c) else c.unmeasured_c),
            shared=ALWAYS,
        ),
    )

# SPDX-License-Identifier: Apache-2.0
"""A4 from one frame: the place and the attitude of the instrument, with their covariance.

The equation is the paper's, section 4: A2 A3 W = A4 A1 V, with refraction in L and the diurnal aberration of the
site.
"""

import math
from dataclasses import dataclass

import numpy as np

from starpos import rotation
from starpos.earth.orientation import EarthState, station_velocity
from starpos.earth.refraction import Atmosphere
from starpos.fix.budget import (
    ErrorTerm,
    Sensitivity,
    error_terms,
    heading_of,
    mount_term,
    place_of,
    total_covariance,
)
from starpos.fix.matched import MatchedStars, SeenFrame, apparent, fit_stars
from starpos.fix.readable import InDegrees
from starpos.frames.shutter import GLOBAL, Shutter
from starpos.frozen import at_once
from starpos.instrument.camera import Camera
from starpos.instrument.inclinometer import Tilt
from starpos.instrument.mounting import Mounting
from starpos.units import ARCSEC


@at_once
@dataclass(frozen=True, kw_only=True)
class Fix(SeenFrame):
    """Astronomic latitude, longitude and heading (rad) at one instant, with the error budget.

    link_to_enu (3, 3): attitude of the base link.
    levelling (6, 2): change of the rows of an ErrorTerm for errors, in rad, of up about two axes fixed to the
    inclinometer.
    """

    latitude: float
    longitude: float
    heading: float
    link_to_enu: np.ndarray
    terms: tuple[ErrorTerm, ...]
    levelling: np.ndarray

    @property
    def covariance(self) -> np.ndarray:
        """Covariance (3, 3) of east m, north m, heading rad."""
        return total_covariance(self.terms)[:3, :3]

    @property
    def in_degrees(self) -> InDegrees:
        """Place and heading in degrees."""
        return InDegrees.of(self.latitude, self.longitude, self.heading, self.covariance)

    def __repr__(self) -> str:
        return f"<Fix: {self.in_degrees}>"

    @property
    def attitude_covariance(self) -> np.ndarray:
        """Covariance (3, 3) in rad2 of the base link's orientation about east, north, up."""
        return total_covariance(self.terms)[3:, 3:]


def solve_fix(
    stars: MatchedStars,
    camera: Camera,
    tilt: Tilt,
    mounting: Mounting,
    atmosphere: Atmosphere,
    earth: EarthState,
    clock_stddev_s: float,
    stamp_stddev_s: float = 0.0,
    shutter: Shutter = GLOBAL,
) -> Fix:
    """The fix of one frame from identified stars.

    clock_stddev_s, stamp_stddev_s: of the clock, and of the frame's time stamp by that clock.
    shutter: when each row was exposed; `earth` is of the row that is read first.
    Raises FixError if the stars are too few or do not agree.
    """
    level, refraction = mounting.level(tilt), atmosphere.refraction()
    g = level.camera
    seen = fit_stars(stars, camera, g, refraction, apparent(stars, earth, shutter, camera.height))
    fit, errors = seen.fit, seen.errors
    place = place_of(fit.a4)
    link_to_enu = place.local_to_enu @ g @ mounting.link_to_camera
    sensitivity = Sensitivity.of(place, link_to_enu)
    # the two axes go with the inclinometer, however it leans
    axes = rotation.shortest_turn(np.array([0.0, 0.0, 1.0]), level.up)[:, :2]
    terms = (
        *error_terms(
            sensitivity=sensitivity,
            stars=errors,
            level=level,
            tilt=tilt,
            mounting=mounting,
            refraction_rotation=seen.bending(atmosphere),
            shutter_rotation=seen.rolling(shutter, camera.height),
            latitude=place.latitude,
            earth=earth,
            clock_stddev_s=clock_stddev_s,
            stamp_stddev_s=stamp_stddev_s,
        ),
        *mount_term("mount", link_to_enu, mounting.link_stddev_rad),
    )
    axis = g @ camera.centre_ray
    bent = math.dist(axis, refraction.unbend(axis))
    return Fix(
        utc_unix_s=earth.utc_unix_s,
        latitude=place.latitude,
        longitude=place.longitude,
        heading=heading_of(link_to_enu),
        link_to_enu=link_to_enu,
        terms=terms,
        levelling=sensitivity.level @ (level.turns @ axes),
        used=np.flatnonzero(fit.keep),
        residual_px=seen.residual,
        residual_arcsec=seen.residual_px * camera.scale_arcsec,
        jitter_px=math.sqrt(fit.jitter2),
        focal_scale=fit.scale,
        zenith_distance=math.acos(min(max(axis[2], -1.0), 1.0)),
        refraction_arcsec=bent / ARCSEC,
        diurnal_aberration_arcsec=math.hypot(*station_velocity(fit.a4[2])) / ARCSEC,
        ut1_minus_utc_s=earth.orientation.ut1_minus_utc_s,
        camera_to_itrs=fit.a4.T @ g,
        camera_covariance=fit.a4.T @ errors.rotation_covariance(errors.centroids) @ fit.a4,
    )

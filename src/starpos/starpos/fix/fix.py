# SPDX-License-Identifier: Apache-2.0
"""A4 from one frame: the place and the attitude of the instrument, with their covariance.

The equation is that of the paper's section 4, A2 A3 W = A4 A1 V, with refraction in L and the diurnal aberration of the
site.
"""

import math
from dataclasses import dataclass

import numpy as np

from starpos import rotation
from starpos.earth.orientation import ROTATION_RAD_S, EarthState, later, station_velocity
from starpos.earth.refraction import Atmosphere
from starpos.errors import FixError
from starpos.fix._adjustment import Adjustment
from starpos.fix.adjustment import ISOTROPIC, Fitted, adjustment_of, fitted, share_free
from starpos.fix.budget import (
    ALWAYS,
    ErrorTerm,
    Sensitivity,
    StarErrors,
    error_terms,
    heading_of,
    place_of,
    total_covariance,
)
from starpos.fix.outliers import expected_extra
from starpos.fix.readable import InDegrees
from starpos.frames.shutter import GLOBAL, Shutter
from starpos.frames.stars import Stars
from starpos.frozen import at_once
from starpos.identification import Identification
from starpos.instrument.camera import Camera
from starpos.instrument.inclinometer import Tilt
from starpos.instrument.mounting import Mounting
from starpos.units import ARCSEC

# share of the frame's diagonal; stars that scatter more were not identified rightly
MAX_SCATTER = 0.003
STEP_REFRACTION = 0.01
# so many stars tell whether two frames show the same ones
MARKS = 20


@at_once
@dataclass(frozen=True)
class MatchedStars:
    """N identified stars; ValueError if the arrays do not fit to each other, FixError if a place's error is not finite.

    xy (N, 2) in px and covariance_px2 (N, 2, 2): where they are on the frame.
    places (N, 3): ICRS directions at the date; place_sigma (N,): their standard deviation per axis in rad.
    index (N,): their rows in the catalogue; None if unknown.
    """

    xy: np.ndarray
    covariance_px2: np.ndarray
    places: np.ndarray
    place_sigma: np.ndarray
    index: np.ndarray | None = None

    def __post_init__(self) -> None:
        n = len(self.xy)
        shapes = (self.xy.shape, self.covariance_px2.shape, self.places.shape, self.place_sigma.shape)
        if shapes != ((n, 2), (n, 2, 2), (n, 3), (n,)) or (self.index is not None and len(self.index) != n):
            raise ValueError(f"arrays of identified stars do not fit to each other: {shapes}")
        if not np.isfinite(self.covariance_px2).all():
            raise FixError("the error of a star's place is not a finite number: leave that star out")


def sound_matches(stars: Stars, found: Identification, enough: int) -> np.ndarray:
    """Mask (M,) of the matches to use: those of stars without a flag, or all if fewer than `enough` have none."""
    sound = stars.sound[found.star]
    return sound if sound.sum() >= enough else np.ones(len(sound), bool)


@at_once
@dataclass(frozen=True, kw_only=True)
class Fix:
    """Astronomic latitude, longitude and heading (rad) at one instant, with the error budget.

    link_to_enu (3, 3): attitude of the base link.
    used (M,): rows of the given stars that were kept; residual_px (M, 2): their fitted places minus their seen ones.
    jitter_px: scatter of the stars beyond the centroids' own errors (seeing, optics).
    focal_scale: factor on the given focal length.
    levelling (6, 2): change of the rows of an ErrorTerm for errors, in rad, of up about two axes fixed to the
    inclinometer. camera_to_itrs (3, 3): attitude of the camera against the Earth by the stars alone; camera_covariance
    (3, 3) in rad2: of its small rotation about the Earth's axes.
    """

    utc_unix_s: float
    latitude: float
    longitude: float
    heading: float
    link_to_enu: np.ndarray
    terms: tuple[ErrorTerm, ...]
    levelling: np.ndarray
    used: np.ndarray
    residual_px: np.ndarray
    residual_arcsec: float
    jitter_px: float
    focal_scale: float
    zenith_distance: float
    refraction_arcsec: float
    diurnal_aberration_arcsec: float
    ut1_minus_utc_s: float
    camera_to_itrs: np.ndarray
    camera_covariance: np.ndarray

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
    problem = adjustment_of(stars.xy, camera, g, _seen(stars, earth, shutter, camera.height), refraction)
    catalogue_px2 = ISOTROPIC * ((stars.place_sigma * camera.fx) ** 2)[:, None, None]
    stated = stars.covariance_px2 + catalogue_px2
    fit = fitted(problem, refraction.unbend(camera.directions(*stars.xy.T) @ g.T), stated)
    if fit.jitter2 > (MAX_SCATTER * math.hypot(camera.width, camera.height)) ** 2:
        raise FixError(
            f"the identified stars lie {math.sqrt(fit.jitter2):.1f} px off the best attitude: check the camera's "
            "distortion"
        )
    kept, residual = fit.kept, fit.residual[fit.kept]
    claimed2 = expected_extra(residual, stated[kept], share_free(fit.keep))
    centroids = stars.covariance_px2[kept] + ISOTROPIC * claimed2
    same_stars = ALWAYS if stars.index is None else tuple(stars.index[kept][:MARKS].tolist())
    errors = StarErrors.of(fit.slope[kept], centroids, catalogue_px2[kept], same_stars)
    if not np.isfinite(errors.gain).all() or not math.isfinite(claimed2):
        raise FixError(
            f"the {len(residual)} stars do not tell the attitude and how well it is known: more stars are needed, "
            "further apart, with sound errors"
        )
    place = place_of(fit.a4)
    link_to_enu = place.local_to_enu @ g @ mounting.link_to_camera
    sensitivity = Sensitivity.of(place, link_to_enu)
    # the two axes go with the inclinometer, however it leans
    axes = rotation.shortest_turn(np.array([0.0, 0.0, 1.0]), level.up)[:, :2]
    terms = error_terms(
        sensitivity,
        errors,
        level,
        tilt,
        mounting,
        _bending(problem, fit, errors, atmosphere),
        _rolling(problem, fit, errors, shutter, camera.height),
        place.latitude,
        earth,
        clock_stddev_s,
        stamp_stddev_s,
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
        residual_px=residual,
        residual_arcsec=math.sqrt(np.vdot(residual, residual) / residual.size) * camera.scale_arcsec,
        jitter_px=math.sqrt(fit.jitter2),
        focal_scale=fit.scale,
        zenith_distance=math.acos(min(max(axis[2], -1.0), 1.0)),
        refraction_arcsec=bent / ARCSEC,
        diurnal_aberration_arcsec=math.hypot(*station_velocity(fit.a4[2])) / ARCSEC,
        ut1_minus_utc_s=earth.orientation.ut1_minus_utc_s,
        camera_to_itrs=fit.a4.T @ g,
        camera_covariance=fit.a4.T @ errors.rotation_covariance(centroids) @ fit.a4,
    )


def _seen(stars: MatchedStars, earth: EarthState, shutter: Shutter, height: int) -> np.ndarray:
    """Geocentric apparent directions (N, 3) of the stars in ITRS, each when its row was exposed."""
    itrs = earth.to_itrs(stars.places)
    return later(itrs, shutter.later_s(stars.xy[:, 1], height)) if shutter.readout_s else itrs


def _bending(problem: Adjustment, fit: Fitted, errors: StarErrors, atmosphere: Atmosphere) -> np.ndarray:
    """Rotation (3,) of A4 in rad for 1 sigma of the refraction."""
    stronger = problem.predict(fit.a4, fit.scale, atmosphere.refraction(1 + STEP_REFRACTION).compiled)
    moved = (stronger - problem.xy - fit.residual)[fit.kept]
    return errors.rotated(moved * (atmosphere.relative_sigma / STEP_REFRACTION))


def _rolling(
    problem: Adjustment, fit: Fitted, errors: StarErrors, shutter: Shutter, height: int
) -> np.ndarray:
    """Rotation (3, 2) of A4 in rad for 1 sigma of the two errors of the rows' times."""
    if not shutter.readout_stddev_s:
        return np.zeros((3, 2))
    # in a second the sky turns about the pole, which is a column of A4
    drift = fit.slope[fit.kept, :, :3] @ (-ROTATION_RAD_S * fit.a4[:, 2])
    late = shutter.errors_s(problem.xy[fit.kept, 1], height)
    return errors.rotated(drift[..., None] * late[:, None])

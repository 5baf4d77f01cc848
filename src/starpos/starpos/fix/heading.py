# SPDX-License-Identifier: Apache-2.0
"""Heading, pitch and roll at a known place: stars give the camera's attitude, the place gives up and north.  It is the
reverse of the fix: there the level is known and A4, which holds the place, is fitted; here A4 is known.
"""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from starpos import rotation
from starpos._numeric.roots import symmetric_root
from starpos.earth.ellipsoid import meridian_turn
from starpos.earth.orientation import ROTATION_RAD_S, EarthState, station_velocity
from starpos.earth.place import Place
from starpos.earth.refraction import Atmosphere
from starpos.errors import FixError, PlaceError
from starpos.fix.budget import ALWAYS, ErrorTerm, heading_of, heading_row, mount_term, total_covariance
from starpos.fix.checks import check_visible
from starpos.fix.star_fit import MatchedStars, SeenFrame, StarFit, apparent, fit_stars
from starpos.frames.exposure import GLOBAL_SHUTTER, Shutter
from starpos.frozen import at_once
from starpos.instrument.camera import Camera
from starpos.instrument.mounting import Mounting
from starpos.units import ARCSEC

# the level settles to this, rad; refraction turns with it, and settles a thousand times faster, or ten times at 10 deg
SETTLED_RAD, MAX_ROUNDS = 1e-9, 10
# minimum share of the refraction expected at the place, and significance in sigma: less belongs to another place
MIN_SHARE, REFRACTION_SIGMAS = 0.5, 5.0


@at_once
@dataclass(frozen=True, kw_only=True)
class LinkAttitude:
    """Attitude of the base link in east, north, up: link_to_enu (3, 3), and its error budget.

    terms: as in a fix; the place is given, so its rows are 0.
    """

    link_to_enu: np.ndarray
    terms: tuple[ErrorTerm, ...]

    @property
    def attitude_covariance(self) -> np.ndarray:
        """Covariance (3, 3) in rad2 of the small rotation about east, north, up."""
        return total_covariance(self.terms)[3:, 3:]

    @property
    def heading(self) -> float:
        """Azimuth (rad, 0 to 2 pi) of the link's x axis, clockwise from north."""
        return heading_of(self.link_to_enu)

    @property
    def pitch(self) -> float:
        """Elevation (rad) of the link's x axis: positive with the nose up, unlike a turn about ROS's y axis."""
        return math.asin(min(max(self.link_to_enu[2, 0], -1.0), 1.0))

    @property
    def roll(self) -> float:
        """Turn (rad, -pi to pi) about the link's x axis: positive with the left side up."""
        return math.atan2(self.link_to_enu[2, 1], self.link_to_enu[2, 2])

    @cached_property
    def covariance(self) -> np.ndarray:
        """Covariance (3, 3) in rad2 of heading, pitch, roll; unbounded where x is vertical."""
        return self._slope @ self.attitude_covariance @ self._slope.T

    @property
    def _slope(self) -> np.ndarray:
        """Change (3, 3) of heading, pitch, roll for small rotations about east, north, up."""
        east, north, _ = self.link_to_enu[:, 0].tolist()
        level = max(math.hypot(east, north), 1e-6)
        pitch = np.array([north, -east, 0.0]) / level
        # about x itself by all of it, and up to the horizon by what the heading turns
        roll = np.array([east, north, 0.0]) / level**2
        return np.array([heading_row(self.link_to_enu), pitch, roll])


@at_once
@dataclass(frozen=True, kw_only=True)
class AttitudeAtPlace(SeenFrame):
    """Attitude of the instrument at a known place, by the stars alone.

    plumb: in east, north, up by the plumb line (astronomic).  ellipsoid: by WGS 84's normal (geodetic).
    true_north: level by the plumb line, north by the ellipsoid, as the fix's attitude in a graph of nodes.
    """

    place: Place
    plumb: LinkAttitude
    ellipsoid: LinkAttitude
    true_north: LinkAttitude

    @property
    def text(self) -> str:
        """The heading by the plumb line, in deg, with its error."""
        sigma = math.degrees(math.sqrt(self.plumb.covariance[0, 0]))
        return f"heading {math.degrees(self.plumb.heading):.5f} +- {sigma:.5f} deg at the known place"

    def __repr__(self) -> str:
        return f"<AttitudeAtPlace: {self.text}>"


def attitude_at_place(
    stars: MatchedStars,
    camera: Camera,
    place: Place,
    mounting: Mounting,
    atmosphere: Atmosphere,
    earth: EarthState,
    clock_stddev_s: float,
    stamp_stddev_s: float = 0.0,
    shutter: Shutter = GLOBAL_SHUTTER,
    axis_stddev: float = 0.0,
) -> AttitudeAtPlace:
    """Heading, pitch and roll of the base link from identified stars at a known place.

    mounting: only its base link on the camera is used.
    axis_stddev: error in rad of the camera's optical axis.
    clock_stddev_s, stamp_stddev_s, shutter: as `solve_fix` has them.
    Raises FixError if the stars are too few or do not agree, PlaceError if they are below the horizon of this place.
    """
    itrs, refraction = apparent(stars, earth, shutter, camera.height), atmosphere.refraction()
    a4 = place.plumb_axes
    rays = camera.directions(*stars.xy.T)
    g = a4 @ rotation.best_rotation(rays, itrs)
    check_visible(float((rays @ g[2]).min()))
    for _ in range(MAX_ROUNDS):
        seen = fit_stars(stars, camera, g, refraction, itrs)
        # the fitted A4 differs from the A4 of the place by the error of the level
        off = a4 @ seen.fit.a4.T
        g = off @ g
        if np.linalg.norm(rotation.to_small_vector(off)) < SETTLED_RAD:
            break
    else:
        raise FixError("the stars lie too low for their refraction to be known: point the camera higher")
    _check_refraction(seen, atmosphere)
    axis = g @ camera.centre_ray
    terms = _rotations(seen, atmosphere, earth, shutter, camera.height, clock_stddev_s, stamp_stddev_s, a4)
    link = g @ mounting.link_to_camera
    to_ellipsoid = place.axes @ a4.T
    turn = math.atan2(to_ellipsoid[0, 1], to_ellipsoid[1, 1])
    north = rotation.about_axis(2, -turn)

    def attitude(link_to_enu: np.ndarray, level_stddev: float, north_stddev: float) -> LinkAttitude:
        moved = _zenith_moved(place.plumb[0])
        errors = {**terms, "place": moved @ place.zenith_root}
        errors["deflection"] = moved * np.array([[level_stddev], [level_stddev], [north_stddev]])
        return LinkAttitude(
            link_to_enu=link_to_enu,
            terms=(
                *(_term(name, rotations, link_to_enu, seen) for name, rotations in errors.items()),
                *mount_term("lens", link_to_enu, axis_stddev),
                *mount_term("mount", link_to_enu, mounting.link_stddev_rad),
            ),
        )

    return AttitudeAtPlace(
        utc_unix_s=earth.utc_unix_s,
        place=place,
        plumb=attitude(link, place.plumb_stddev, place.plumb_stddev),
        ellipsoid=attitude(to_ellipsoid @ link, place.ellipsoid_stddev, place.ellipsoid_stddev),
        true_north=attitude(north @ link, place.plumb_stddev, place.ellipsoid_stddev),
        used=np.flatnonzero(seen.fit.keep),
        residual_px=seen.residual,
        residual_arcsec=seen.residual_px * camera.scale_arcsec,
        jitter_px=math.sqrt(seen.fit.jitter2),
        focal_scale=seen.fit.scale,
        zenith_distance=math.acos(min(max(axis[2], -1.0), 1.0)),
        refraction_arcsec=math.dist(axis, refraction.unbend(axis)) / ARCSEC,
        diurnal_aberration_arcsec=math.hypot(*station_velocity(a4[2])) / ARCSEC,
        ut1_minus_utc_s=earth.orientation.ut1_minus_utc_s,
        camera_to_itrs=a4.T @ g,
        camera_covariance=a4.T @ seen.errors.rotation_covariance(seen.errors.centroids) @ a4,
    )


def _check_refraction(seen: StarFit, atmosphere: Atmosphere) -> None:
    """Raise PlaceError if the air does not bend the field as it must at this place."""
    if atmosphere.pressure_pa == 0:
        return
    share, sigma = seen.refraction_seen(atmosphere)
    # few stars hardly determine their scatter (Student's t)
    sigmas = REFRACTION_SIGMAS * (1 + 5 / len(seen.residual))
    if share < MIN_SHARE and 1 - share > sigmas * sigma:
        raise PlaceError(
            f"from the given place the air would bend this field more than the stars show ({share:.2f} +- {sigma:.2f} of "
            "it): check latitude and longitude, their order and signs, the clock, and the camera's fx and fy"
        )


def _rotations(
    seen: StarFit,
    atmosphere: Atmosphere,
    earth: EarthState,
    shutter: Shutter,
    height: int,
    clock_stddev_s: float,
    stamp_stddev_s: float,
    a4: np.ndarray,
) -> dict[str, np.ndarray]:
    """Rotations (3, m) of the sky about east, north, up, rad, for 1 sigma of each source."""
    errors, orientation = seen.errors, earth.orientation
    pole = a4[:, 2]
    # a second of time turns the sky about the pole; the pole itself errs about the two axes across
    second = ROTATION_RAD_S * pole[:, None]
    return {
        "centroids": symmetric_root(errors.rotation_covariance(errors.centroids)),
        "catalogue": symmetric_root(errors.rotation_covariance(errors.catalogue)),
        "refraction": seen.bending(atmosphere)[:, None],
        "shutter": seen.rolling(shutter, height),
        "clock": second * clock_stddev_s,
        "time stamp": second * stamp_stddev_s,
        "ut1": second * orientation.ut1_sigma_s,
        "pole": a4[:, :2] * orientation.pole_sigma,
    }


def _zenith_moved(latitude: float) -> np.ndarray:
    """Rotation (3, 2) of an attitude in east, north, up, for a zenith that lies 1 rad further east, or north."""
    return np.array([[0.0, 1.0], [-1.0, 0.0], [-meridian_turn(latitude), 0.0]])


def _term(name: str, rotations: np.ndarray, link_to_enu: np.ndarray, seen: StarFit) -> ErrorTerm:
    factor = np.vstack([np.zeros((2, rotations.shape[1])), heading_row(link_to_enu) @ rotations, rotations])
    shared = {"centroids": None, "catalogue": seen.errors.same_stars}.get(name, ALWAYS)
    return ErrorTerm(name, factor, shared=shared)

# SPDX-License-Identifier: Apache-2.0
"""Heading, pitch and roll at a known place: stars give the camera's attitude, the place gives up and north.  It is the
reverse of the fix: there the level is known and A4, which holds the place, is fitted; here A4 is known.
"""

import math
from dataclasses import dataclass

import numpy as np

from starpos import rotation
from starpos._numeric.roots import symmetric_root
from starpos.earth.ellipsoid import meridian_turn
from starpos.earth.orientation import ROTATION_RAD_S, EarthState
from starpos.earth.place import Place
from starpos.earth.refraction import Atmosphere
from starpos.errors import FixError, PlaceError
from starpos.fix.attitude import CAMERA, ENU, Attitude, heading_row
from starpos.fix.budget import link_attitude, mount_term
from starpos.fix.checks import check_visible
from starpos.fix.sighting import FittedSighting, fitted_fields
from starpos.fix.star_fit import MatchedStars, StarFit, apparent, fit_stars
from starpos.fix.terms import ALWAYS, ErrorTerm, total_covariance
from starpos.frames.exposure import GLOBAL_SHUTTER, Shutter
from starpos.frozen import at_once
from starpos.instrument.camera import Camera
from starpos.instrument.mounting import Mounting

# the level settles to this, rad; refraction turns with it, and settles a thousand times faster, or ten times at 10 deg
SETTLED_RAD, MAX_ROUNDS = 1e-9, 10
# minimum share of the refraction expected at the place, and significance in sigma: less belongs to another place
MIN_SHARE, REFRACTION_SIGMAS = 0.5, 5.0


@at_once
@dataclass(frozen=True, kw_only=True)
class AttitudeAtPlace(FittedSighting):
    """Attitude of the instrument at a known place, by the stars alone.

    plumb: in east, north, up by the plumb line (astronomic).  ellipsoid: by WGS 84's normal (geodetic).
    true_north: level by the plumb line, north by the ellipsoid, as the fix's attitude in a graph of nodes.
    """

    place: Place
    plumb: Attitude
    ellipsoid: Attitude
    true_north: Attitude

    @property
    def optics(self) -> Attitude:
        """The camera C in east, north, up by the plumb line; the base link's mounting has no part in it."""
        terms = tuple(t for t in self.plumb.terms if t.name != "mount")
        covariance = total_covariance(terms)[3:, 3:]
        seen = self.place.plumb_axes @ self.camera.rotation
        return Attitude(seen, covariance, of=CAMERA, into=ENU, terms=terms)

    @property
    def text(self) -> str:
        """The heading by the plumb line, in deg, with its error."""
        sigma = math.degrees(math.sqrt(self.plumb.angles_covariance[0, 0]))
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
    terms = _rotations(seen, atmosphere, earth, shutter, camera.height, clock_stddev_s, stamp_stddev_s, a4)
    link = g @ mounting.link_to_camera
    to_ellipsoid = place.axes @ a4.T
    turn = math.atan2(to_ellipsoid[0, 1], to_ellipsoid[1, 1])
    north = rotation.about_axis(2, -turn)

    def attitude(link_to_enu: np.ndarray, level_stddev: float, north_stddev: float) -> Attitude:
        moved = _zenith_moved(place.plumb[0])
        errors = {**terms, "place": moved @ place.zenith_root}
        errors["deflection"] = moved * np.array([[level_stddev], [level_stddev], [north_stddev]])
        return link_attitude(
            link_to_enu,
            (
                *(_term(name, rotations, link_to_enu, seen) for name, rotations in errors.items()),
                *mount_term("lens", link_to_enu, axis_stddev),
                *mount_term("mount", link_to_enu, mounting.link_stddev_rad),
            ),
        )

    return AttitudeAtPlace(
        **fitted_fields(seen, camera, g, a4, refraction, earth),
        clock_stddev_s=clock_stddev_s,
        stamp_stddev_s=stamp_stddev_s,
        place=place,
        plumb=attitude(link, place.plumb_stddev, place.plumb_stddev),
        ellipsoid=attitude(to_ellipsoid @ link, place.ellipsoid_stddev, place.ellipsoid_stddev),
        true_north=attitude(north @ link, place.plumb_stddev, place.ellipsoid_stddev),
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

# SPDX-License-Identifier: Apache-2.0
"""Heading, pitch and roll at a known place: stars give the camera's attitude, the place gives up and north.  It is the
reverse of the fix: there the level is known and A4, which holds the place, is fitted; here A4 is known.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from starpos import rotation
from starpos.earth.ellipsoid import meridian_turn
from starpos.earth.place import Place
from starpos.earth.refraction import Atmosphere
from starpos.errors import FixError, PlaceError
from starpos.fix.attitude import CAMERA, ENU, Attitude, heading_row
from starpos.fix.budget import Circumstances, link_attitude, mount_term, sky_terms
from starpos.fix.checks import check_visible
from starpos.fix.sighting import FittedSighting, fitted_fields
from starpos.fix.star_fit import MatchedStars, StarFit, adjustment_of, apparent, fit_stars
from starpos.fix.terms import ALWAYS, ErrorTerm, total_covariance
from starpos.frozen import at_once
from starpos.identification import fisheye
from starpos.instrument.instrument import Instrument

# the level settles to this, rad; refraction turns with it, and settles a thousand times faster, or ten times at 10 deg
SETTLED_RAD, MAX_ROUNDS = 1e-9, 10
# minimum share of the refraction expected at the place, and significance in sigma: less belongs to another place
MIN_SHARE, REFRACTION_SIGMAS = 0.5, 5.0
# sigma beyond which the zenith that refraction shows contradicts time and place, and how far off (rad) it may seem to be
ZENITH_SIGMAS, ZENITH_RAD = 5.0, math.radians(2)
# residuals beyond the stars' errors are of the lens, and alike for neighbours: number of independent ones on a frame
LENS_VALUES = 20
# a zenith that refraction shows within this (rad), with two sigma, confirms the hour. With a lens that is fitted to a
# single frame the right hour's is within 4 deg; one hour off it is beyond 7, as the lens takes up the rest of 15
CONFIRMED_RAD = math.radians(5)
# a camera whose optical axis is not where it is taken to be seems to lean so much, and, where its stars do not lie all
# around, to have turned about its axis by this share
ROLLED = 0.05
# step of the numerical derivatives, rad
STEP_RAD = 1e-3


@at_once
@dataclass(frozen=True, kw_only=True)
class AttitudeAtPlace(FittedSighting):
    """Attitude of the instrument at a known place, by the stars alone, or by the Sun and the level.

    hour_shown: whether the stars themselves show that place and time fit, to an hour.
    plumb: in east, north, up by the plumb line (astronomic).  ellipsoid: by WGS 84's normal (geodetic).
    true_north: level by the plumb line, north by the ellipsoid, as the fix's attitude in a graph of nodes.
    """

    place: Place
    plumb: Attitude
    ellipsoid: Attitude
    true_north: Attitude
    hour_shown: bool = True

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


def attitude_at_place(stars: MatchedStars, place: Place, about: Circumstances) -> AttitudeAtPlace:
    """Heading, pitch and roll of the base link from identified stars at a known place.

    about: of its instrument only the base link on the camera is used.
    Raises FixError if the stars are too few or do not agree, PlaceError if they are below the horizon of this place.
    """
    camera, atmosphere = about.camera, about.atmosphere
    itrs, refraction = apparent(stars, about), atmosphere.refraction()
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
    shown = True
    if fisheye.is_wide(camera) and atmosphere.pressure_pa:
        leaned = [rotation.from_vector(turn) for turn in np.eye(3)[:2] * STEP_RAD]
        leaning = [
            adjustment_of(stars.xy, camera, r @ g, itrs, refraction).predict(
                r @ seen.fit.a4, seen.fit.scale, refraction
            )
            for r in leaned
        ]
        shown = any(camera.distortion) and _zenith_shown(seen, np.stack(leaning, -1), atmosphere)
    moved = zenith_moved(place.plumb[0])
    terms = (
        *seen.terms(np.eye(3), about),
        *sky_terms(np.eye(3), about.earth, about.clock_stddev_s, about.stamp_stddev_s, a4),
        ErrorTerm("place", moved @ place.zenith_root, shared=ALWAYS),
        ErrorTerm("lens", g * np.array([1, 1, ROLLED]) * about.axis_stddev, shared=ALWAYS),
    )
    deflected = moved * place.plumb_stddev, moved * place.ellipsoid_stddev
    return AttitudeAtPlace(
        **fitted_fields(seen, about, g, a4),
        **attitudes_at(place, g, about.instrument, terms, deflected),
        place=place,
        hour_shown=shown,
    )


def attitudes_at(
    place: Place,
    g: np.ndarray,
    instrument: Instrument,
    terms: Iterable[ErrorTerm],
    deflected: tuple[np.ndarray, np.ndarray],
) -> dict[str, Any]:
    """The base link by the plumb line, by the ellipsoid, and level by the first with north by the second.

    g (3, 3): C into east, north, up by the plumb line.  terms: their factors are rotations (3, m) about these.
    deflected: rotations (3, m) by 1 sigma of the deflection, by the plumb line and by the ellipsoid.
    """
    link = g @ instrument.link_to_camera
    plumb, ellipsoid = deflected

    def attitude(link_to_enu: np.ndarray, deflection: np.ndarray) -> Attitude:
        def whole(term: ErrorTerm) -> ErrorTerm:
            turns = term.factor
            rows = np.vstack([np.zeros((2, turns.shape[1])), heading_row(link_to_enu) @ turns, turns])
            return replace(term, factor=rows)

        return link_attitude(
            link_to_enu,
            (
                *map(whole, terms),
                whole(ErrorTerm("deflection", deflection, shared=ALWAYS)),
                *mount_term(link_to_enu, instrument),
            ),
        )

    return {
        "plumb": attitude(link, plumb),
        "ellipsoid": attitude(place.axes @ place.plumb_axes.T @ link, ellipsoid),
        "true_north": attitude(place.to_geodetic_north @ link, np.vstack([plumb[:2], ellipsoid[2:]])),
    }


def _check_refraction(seen: StarFit, atmosphere: Atmosphere) -> None:
    """Raise PlaceError if the air does not bend the field as it must at this place."""
    if atmosphere.pressure_pa == 0:
        return
    # an attitude and a plate scale absorb most of the refraction; the rest compresses the field along the vertical
    [stronger], [[variance]] = seen.more(np.zeros((len(seen.residual), 2, 0)), atmosphere)
    share, sigma = 1 + float(stronger), math.sqrt(variance)
    # few stars hardly determine their scatter (Student's t)
    sigmas = REFRACTION_SIGMAS * (1 + 5 / len(seen.residual))
    if share < MIN_SHARE and 1 - share > sigmas * sigma:
        raise PlaceError(
            f"from the given place the air would bend this field more than the stars show ({share:.2f} +- {sigma:.2f} of "
            "it): check latitude and longitude, their order and signs, the clock, and the camera's fx and fy"
        )


def _zenith_shown(seen: StarFit, leaned: np.ndarray, atmosphere: Atmosphere) -> bool:
    """Whether refraction shows the zenith; PlaceError if it shows another one.

    leaned (N, 2, 2): places of the stars in px, if the zenith were STEP_RAD further along each axis.
    """
    kept = seen.fit.kept
    moved = (leaned[kept] - (seen.problem.xy + seen.fit.residual)[kept, :, None]) / STEP_RAD
    found, covariance = seen.more(moved, atmosphere)
    return confirms_hour(*checked_zenith(found, covariance * feigned(seen.fit.jitter2, seen.centroids)))


def confirms_hour(lean: float, sigma: float) -> bool:
    """Whether the zenith by refraction, so far (rad) from the one by time and place, shows that these fit."""
    return lean + 2 * sigma < CONFIRMED_RAD


def feigned(jitter2: float, stated: np.ndarray) -> float:
    """Factor by which a lens that is not modelled widens covariances; stated (N, 2, 2): of the stars' places, px2.

    jitter2: variance of the stars beyond it, px2.
    """
    share = jitter2 / (jitter2 + float(np.trace(stated, axis1=1, axis2=2).mean()) / 2)
    # a few percent of it are chance
    return 1 + max(share - 3 / math.sqrt(len(stated)), 0.0) * len(stated) / LENS_VALUES


def checked_zenith(lean: np.ndarray, covariance: np.ndarray) -> tuple[float, float]:
    """How far (rad) the zenith by refraction is from the one by time and place, and its error along the worse axis.

    lean (2,), covariance (2, 2): two small rotations, rad.  Raises PlaceError if they differ.
    """
    off, sigma = float(np.linalg.norm(lean)), float(np.sqrt(np.linalg.eigvalsh(covariance)[-1]))
    if off > ZENITH_RAD and lean @ np.linalg.solve(covariance, lean) > ZENITH_SIGMAS**2:
        raise PlaceError(
            f"refraction shows the zenith {math.degrees(off):.1f} +- {math.degrees(sigma):.1f} deg from where time and "
            "place put it: check latitude and longitude, their order and signs, and the hour (UTC, not local time)"
        )
    return off, sigma


def zenith_moved(latitude: float) -> np.ndarray:
    """Rotation (3, 2) of an attitude in east, north, up, for a zenith that lies 1 rad further east, or north."""
    return np.array([[0.0, 1.0], [-1.0, 0.0], [-meridian_turn(latitude), 0.0]])

# SPDX-License-Identifier: Apache-2.0
"""Frames under way: the attitude of the camera against the Earth by their stars, and the body's at a known place.  No
level is needed: only refraction and the diurnal aberration depend on the zenith, and hardly.
"""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np

from starpos import rotation
from starpos.earth.orientation import ROTATION_RAD_S, earth_orientation, earth_state, station_velocity
from starpos.earth.place import Place
from starpos.earth.refraction import Atmosphere
from starpos.errors import FixError, FrameError, InstrumentError, TimeError
from starpos.fix import solver
from starpos.fix.attitude import CAMERA, ENU, GCRS, ITRS, LINK, Attitude, CameraAttitude
from starpos.fix.heading import zenith_moved
from starpos.fix.sighting import Sighting
from starpos.fix.solution import Solution
from starpos.fix.star_fit import MatchedStars, fit_seen, sound_matches
from starpos.frames.frame import Stars
from starpos.frames.reading import why_no_time
from starpos.identification import fisheye
from starpos.instrument.camera import Camera
from starpos.navigation.vessel import Vessel
from starpos.sky.bodies import SUN, Body, body_at
from starpos.units import ARCSEC

# of an attitude without refraction; 1 sigma
ROUGH = 20 * ARCSEC


@dataclass(frozen=True, eq=False, kw_only=True)
class FrameUnderWay(Sighting, ABC):
    """A sighting whose attitude is computed again under each zenith that is tried."""

    def rough(self) -> Attitude:
        """The attitude as it is without a place, good to ROUGH."""
        return Attitude(self.camera.rotation, np.eye(3) * ROUGH**2, of=CAMERA, into=ITRS)

    @abstractmethod
    def under(self, zenith: np.ndarray, atmosphere: Atmosphere) -> tuple[Attitude, np.ndarray]:
        """The attitude under a zenith (3,) in ITRS, and how it turns if refraction is stronger by its own size.

        The turn is a small rotation (3,) about ITRS's axes, rad.
        """


# Refraction squeezes a frame more along the vertical than across. This turns the attitude across the axis if the middle
# of the stars is off the axis (rad), and about it if stars spread farther one way than the other (share): 1 sigma.
OFF_AXIS, SPREAD = 0.03, 0.25
# sine of the lowest altitude that this is for
LOWEST = 0.1
CIRCLE = np.array([[np.cos(a), np.sin(a)] for a in np.arange(8) * np.pi / 4])


@dataclass(frozen=True, eq=False, kw_only=True)
class PlacelessFrame(FrameUnderWay):
    """An attitude by stars, which refraction and diurnal aberration have turned, as CameraAttitude has it."""

    @classmethod
    def of(cls, attitude: CameraAttitude) -> "PlacelessFrame":
        """The frame of an attitude; TimeError outside the IERS tables."""
        turn = attitude.camera_to_gcrs
        among_stars = Attitude(turn, turn @ attitude.covariance @ turn.T, of=CAMERA, into=GCRS)
        return cls(
            utc_unix_s=attitude.utc_unix_s,
            stamp_stddev_s=attitude.stamp_stddev_s,
            camera=among_stars.then(earth_state(attitude.utc_unix_s).gcrs_to_itrs, ITRS),
        )

    def under(self, zenith: np.ndarray, atmosphere: Atmosphere) -> tuple[Attitude, np.ndarray]:
        """The attitude under a zenith (3,) in ITRS, from where stars around the camera's axis would be seen there.

        The attitude's covariance gives the distance of the frame's own stars from it.  The fitted plate scale has
        absorbed the effect of refraction that is the same in all directions.  The covariance contains the rest, which
        depends on the directions in which the stars lie.
        """
        given, covariance = self.camera.rotation, self.camera.covariance_about_own
        across, about = np.diag(covariance)[:2].mean(), covariance[2, 2]
        ring = np.column_stack([np.sqrt(across / about) * CIRCLE, np.ones(len(CIRCLE))])
        true = rotation.normalised(ring) @ given.T
        apparent = rotation.normalised(true + station_velocity(zenith))
        level = rotation.shortest_turn(zenith, np.array([0.0, 0.0, 1.0]))
        seen = atmosphere.refraction().bend(apparent @ level.T) @ level
        camera = rotation.best_rotation(true, seen) @ given
        raised = rotation.to_small_vector(rotation.best_rotation(apparent, seen))
        height = max(float(seen.mean(0) @ zenith), LOWEST)
        squeezed = float(np.linalg.norm(raised)) * np.sqrt(1 - min(height, 1.0) ** 2) / height
        uneven = squeezed * np.array([OFF_AXIS, OFF_AXIS, SPREAD])
        whole = covariance + np.diag(uneven**2)
        return Attitude(camera, camera @ whole @ camera.T, of=CAMERA, into=ITRS), raised


def sighting_of(stars: Stars, eye: solver.Solver, answer: Solution) -> PlacelessFrame:
    """The frame under way of stars that are identified; a StarposError says why it cannot be used.

    answer: of these stars, by the solver's camera.
    """
    mid_unix_s = stars.mid_unix_s
    if mid_unix_s is None:
        raise TimeError(f"{stars.place}: no time of exposure: {why_no_time(stars)}")
    camera, catalogue, _ = eye.view(stars.width, stars.height, stars.origin_px)
    if fisheye.is_wide(camera):
        raise InstrumentError(
            f"{stars.place}: frames of a fisheye give no position under way: use a narrower lens"
        )
    if answer.found is None:
        raise FrameError(answer.message)
    if answer.warnings:
        raise FrameError(
            f"{stars.place}: its stars do not belong to one sky ({', '.join(answer.warnings)}): left out"
        )
    if answer.found.mirrored:
        raise InstrumentError(f"{stars.place}: the frame is mirrored (its rows run bottom-up): flip it")
    found, state = answer.found, earth_state(mid_unix_s)
    use = sound_matches(stars, found, solver.ENOUGH_SOUND)
    places = catalogue.directions(found.catalogue[use], state.year, state.observer_au)
    matched = MatchedStars.of(stars, found, use, camera, catalogue, state.year, places)
    catalogue_px2 = np.square(matched.place_sigma * camera.fx)[:, None, None]
    try:
        attitude = placeless(
            matched.xy,
            matched.covariance_px2 + np.eye(2) * catalogue_px2,
            camera.scaled(found.focal_scale),
            state.to_itrs(places),
        )
    except FixError as error:
        raise FixError(f"{stars.place}: {error}: left out") from None
    return PlacelessFrame(
        utc_unix_s=mid_unix_s, stamp_stddev_s=stars.stamp_stddev_s, source=stars.place, camera=attitude
    )


def placeless(xy: np.ndarray, covariance_px2: np.ndarray, optics: Camera, itrs: np.ndarray) -> Attitude:
    """Fit attitude and plate scale where no zenith is known: refraction and diurnal aberration stay in it.

    xy (N, 2), covariance_px2 (N, 2, 2): stars on a frame of a camera, px.  itrs (N, 3): geocentric apparent directions.
    FixError if the stars disagree.
    """
    seen = fit_seen(xy, covariance_px2, optics, itrs)
    return Attitude(np.eye(3), seen.own, of=CAMERA, into=CAMERA).then(seen.fit.a4.T, ITRS)


# how far a direction that is said to be the Sun's may be from it, rad
SUN_NEAR = math.radians(0.05)
# cosine of the altitude above which errors of the Sun's direction count no more in the heading
HIGHEST_COSINE = 0.05


@dataclass(frozen=True, eq=False, kw_only=True)
class SunFrame(FrameUnderWay):
    """The Sun seen from a known place: one direction, about which gravity determines the camera's turn.

    ray (3,): in C.  body: the Sun.  place: where it is seen from.
    """

    ray: np.ndarray
    body: Body
    place: Place

    @classmethod
    def of(cls, seen: CameraAttitude, place: Place) -> "SunFrame":
        """The frame of an attitude that has a ray; FrameError for another direction than the Sun's."""
        assert seen.ray is not None
        state = earth_state(seen.utc_unix_s)
        body, turn = body_at(SUN, state), state.gcrs_to_itrs @ seen.camera_to_gcrs
        if np.linalg.norm(turn @ seen.ray - body.itrs) > SUN_NEAR:
            raise FrameError("an attitude about one direction, which is not the Sun's: left out")
        return cls(
            utc_unix_s=seen.utc_unix_s,
            stamp_stddev_s=seen.stamp_stddev_s,
            camera=Attitude(turn, turn @ seen.covariance @ turn.T, of=CAMERA, into=ITRS),
            ray=seen.ray,
            body=body,
            place=place,
        )

    def rough(self) -> Attitude:
        return self.camera

    def under(self, zenith: np.ndarray, atmosphere: Atmosphere) -> tuple[Attitude, np.ndarray]:
        """The attitude under a zenith (3,) in ITRS, turned anyhow about the Sun."""
        true = self.body.from_place(zenith)
        level = rotation.shortest_turn(zenith, np.array([0.0, 0.0, 1.0]))
        bent, raised = atmosphere.raised(level @ true)
        seen = bent @ level
        turn = rotation.shortest_turn(self.camera.rotation @ self.ray, seen) @ self.camera.rotation
        layers = raised**2 - (math.dist(seen, true) * atmosphere.relative_sigma) ** 2
        across = rotation.normalised(np.cross(zenith, seen))
        covariance = turn @ self.camera.covariance_about_own @ turn.T + layers * np.outer(across, across)
        return Attitude(turn, covariance, of=CAMERA, into=ITRS), np.cross(true, seen)

    def heading_by(self, link: Attitude) -> Attitude:
        """The body's attitude at the known place: level by the plumb line, north by WGS 84.

        link: along astronomic east, north, up, by an adjustment that takes errors for new in each frame.  Errors of
        the lens, the place and the plumb line are not: they are added once more as they are in one frame.
        """
        sine = float(self.body.itrs @ self.place.plumb_axes[2])
        across = np.linalg.eigvalsh(self.camera.covariance)[1]
        root = self.place.zenith_root
        common = across + self.place.plumb_stddev**2 + float(np.linalg.eigvalsh(root @ root.T)[1])
        common /= max(1 - sine**2, HIGHEST_COSINE**2)
        return Attitude(
            self.place.to_geodetic_north @ link.rotation,
            link.covariance + common * np.eye(3),
            of=LINK,
            into=ENU,
        )


def body_attitude(frame: PlacelessFrame, place: Place, vessel: Vessel) -> Attitude:
    """The body's axes, x forward, at a known place: level by the plumb line, north by WGS 84.

    The errors are of stars, air, time, place, deflection and mount.
    """
    a4, air = place.plumb_axes, vessel.atmosphere
    against_earth, by_refraction = frame.under(a4[2], air)
    seen = against_earth.then(a4, ENU)
    late_s = [frame.stamp_stddev_s, vessel.clock_stddev_s, earth_orientation(frame.utc_unix_s).ut1_sigma_s]
    moved = zenith_moved(place.plumb[0])
    columns = np.column_stack([
        a4 @ by_refraction * air.relative_sigma,
        a4[:, 2] * ROTATION_RAD_S * math.hypot(*late_s),
        moved @ place.zenith_root,
        moved * np.array([[place.plumb_stddev], [place.plumb_stddev], [place.ellipsoid_stddev]]),
    ])  # fmt: skip
    covariance = seen.covariance + columns @ columns.T + np.eye(3) * vessel.mount_stddev**2
    return Attitude(
        place.to_geodetic_north @ seen.rotation @ vessel.camera_to_body.T, covariance, of=LINK, into=ENU
    )

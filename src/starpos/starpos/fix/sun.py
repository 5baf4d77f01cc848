# SPDX-License-Identifier: Apache-2.0
"""The attitude by the Sun, or the Moon, and the level: at a known place, whose ephemeris says where the body stands.

Two directions make an attitude, the body's and the plumb line's. They contain the altitude twice: that excludes a
lamp, and makes the attitude better than by either. Without a place one frame gives a circle of equal altitude.
"""

import math
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from starpos import rotation
from starpos._numeric.roots import symmetric_root
from starpos.earth.orientation import EarthState, earth_state, station_velocity
from starpos.earth.place import Place, Places
from starpos.errors import FixError, InstrumentError, PlaceError, StarposError
from starpos.fix.attitude import ANY_TURN, CAMERA, ITRS, Attitude, CameraAttitude
from starpos.fix.budget import sky_terms, tilt_terms
from starpos.fix.circle import MIN_SINE, Circle, circle_along
from starpos.fix.glows import Glow
from starpos.fix.heading import AttitudeAtPlace, attitudes_at, zenith_moved
from starpos.fix.solution import Solution
from starpos.fix.solver import Solver
from starpos.fix.terms import ALWAYS, ErrorTerm, total_covariance
from starpos.frames.frame import Disc, Stars
from starpos.instrument.camera import Camera
from starpos.instrument.inclinometer import Tilt
from starpos.instrument.tilt_log import NO_TILTS, Tilts
from starpos.sky.bodies import MOON, SUN, Body, body_at
from starpos.units import ARCSEC

# The focal length and the distortion err by this share of the way from the axis.
LENS_SHARE = 1e-3
# A limb is the body's if its radius is to this share, and px.  A glow is at most so wide, rad.
SIZE_SHARE, SIZE_PX, WIDEST_GLOW = 0.06, 1.0, math.radians(10.0)
# A body's altitude by the level differs from the ephemeris' by at most this; a glow may be a lamp as well.
LIMB_SIGMAS, GLOW_SIGMAS = 5.3, 3.0
# of the lowest true altitude, -0.2 deg: there the disc stands on the horizon
LOWEST_SINE = -0.0035
# a lens in which the Sun's radius is larger, px, shows its limb: there a glow is a lamp or a cloud
RESOLVED_PX = 6.0


@dataclass(frozen=True, eq=False)
class _Seen:
    """A disc as a direction: ray (3,) in C, its change (3, 2) by a px, and its radius, rad.

    own (3, 2), lens (3, 1): its errors in rad, new in each frame and of the lens.
    """

    ray: np.ndarray
    slope: np.ndarray
    own: np.ndarray
    lens: np.ndarray
    radius: float

    @classmethod
    def of(cls, disc: Disc, camera: Camera, place: str) -> "_Seen":
        x, y, r = disc.x, disc.y, disc.radius_px
        rays = camera.directions(x + np.array([0, 1, 0, r, -r, 0, 0]), y + np.array([0, 0, 1, 0, 0, r, -r]))
        ray = rays[0]
        if not np.isfinite(rays).all():
            raise FixError(f"{place}: the bright disc lies at the rim of the lens's picture: turn the camera")
        slope = (rays[1:3] - ray).T
        off_axis = np.array([x - camera.cx, y - camera.cy])
        return cls(
            ray,
            slope,
            slope @ symmetric_root(disc.covariance),
            slope @ off_axis[:, None] * LENS_SHARE,
            float(np.arccos(np.clip(rays[3:] @ ray, -1, 1)).mean()),
        )


def sun_alone(solver: Solver, stars: Stars, disc: Disc, frame_id: str) -> CameraAttitude | None:
    """The attitude of a frame that shows the Sun, but for the turn about it; None for a disc of another size."""
    if stars.mid_unix_s is None:
        return None
    try:
        state, camera, seen, stamp_s = _looked_at(solver, stars, disc, earth_state(stars.mid_unix_s))
        body = body_at(SUN, state, solver.ephemeris)
        _check_size(disc, seen, body, camera, stars.place)
    except StarposError:
        return None
    if seen.ray[2] <= 0:
        return None
    own = np.column_stack([seen.own, seen.lens, np.eye(3) * body.sigma])
    turns = np.cross(seen.ray, own.T)
    return CameraAttitude(
        utc_unix_s=state.utc_unix_s,
        stamp_stddev_s=stamp_s,
        clock_stddev_s=solver.clock_stddev_s(stars),
        frame_id=frame_id,
        camera_to_gcrs=rotation.shortest_turn(seen.ray, state.gcrs_to_itrs.T @ body.itrs),
        covariance=turns.T @ turns + ANY_TURN * np.outer(seen.ray, seen.ray),
        stars=0,
        log_odds=0.0,
    )


def _looked_at(
    solver: Solver, stars: Stars, disc: Disc, state: EarthState
) -> tuple[EarthState, Camera, _Seen, float]:
    """The state at the disc's row, the camera, the disc as a direction, and the error of its time, s."""
    shutter = solver.shutter(stars)
    row = np.array([disc.y])
    if late_s := float(shutter.later_s(row, stars.height)[0]):
        state = earth_state(state.utc_unix_s + late_s)
    camera = solver.instrument.camera_for(stars.width, stars.height, stars.origin_px)
    seen = _Seen.of(disc, camera, stars.place)
    return (
        state,
        camera,
        seen,
        math.hypot(stars.stamp_stddev_s, *shutter.errors_s(row, stars.height)[0].tolist()),
    )


def by_sun(solver: Solver, stars: Stars, disc: Disc, tilts: Tilts | None, places: Places | None) -> Solution:
    """The attitude of a frame that shows the Sun or the Moon, or without a known place its circle of equal altitude.

    A fault of the frame, the tilt, the time or the place is a status.
    """
    glow = None
    try:
        if tilts is None and solver.instrument.vertical is None:
            raise InstrumentError(
                f"{stars.place}: one bright disc, as the Sun's, is a single direction: its heading takes the level: give "
                "the tilts"
            )
        if solver.instrument.calibration.unknown:
            raise InstrumentError(
                f"{stars.place}: the Sun needs the misalignment of camera and inclinometer (A3): find it by night at a "
                "known place, or state it"
            )
        state, tilt = solver.levelled(stars, tilts or NO_TILTS)
        state, camera, seen, stamp_s = _looked_at(solver, stars, disc, state)
        if not disc.sharp:
            sigma = float(np.linalg.norm(seen.own)) / math.sqrt(2)
            glow = Glow(state.utc_unix_s, seen.ray, body_at(SUN, state, solver.ephemeris).itrs, sigma)
        if places is None:
            return replace(_on_circle(solver, stars, disc, seen, tilt, state, stamp_s), glow=glow)
        place, wrong = places.at(state.utc_unix_s), None
        for name in (SUN, MOON) if disc.sharp else (SUN,):
            try:
                body = body_at(name, state, solver.ephemeris)
                _check_size(disc, seen, body, camera, stars.place)
                found = _attitude(solver, stars, disc, seen, body, tilt, state, place, stamp_s)
            except PlaceError as error:
                wrong = wrong or error
                continue
            return Solution.of(
                stars,
                f"{found.text}, by the {name.title()}",
                at_place=found,
                tilt=tilt,
                bodies=(name,),
                glow=glow,
                extrapolated_days=state.orientation.extrapolated_days,
            )
        assert wrong is not None
        raise wrong
    except StarposError as error:
        return replace(Solution.refused(stars, error), glow=glow)


def _check_size(disc: Disc, seen: _Seen, body: Body, camera: Camera, place: str) -> None:
    """Raise PlaceError if a disc is not as wide as the body."""
    if not disc.sharp and body.radius * disc.radius_px > RESOLVED_PX * seen.radius:
        raise PlaceError(
            f"{place}: a bright spot without a limb, in a lens that shows the Sun's: it is a lamp or a cloud, or the Sun "
            "without a filter, behind which alone such a lens may look at it"
        )
    if disc.sharp:
        off = abs(seen.radius / body.radius - 1) > SIZE_SHARE + SIZE_PX / disc.radius_px
    else:
        off = not body.radius * (1 - SIZE_PX / disc.radius_px) < seen.radius < WIDEST_GLOW
    if off:
        raise PlaceError(
            f"{place}: its bright disc is {math.degrees(2 * seen.radius):.2f} deg wide and the {body.name.title()} "
            f"{math.degrees(2 * body.radius):.2f}: it is not the {body.name.title()}, or the focal length "
            f"({camera.fx:.0f} px) is wrong"
        )


def _on_circle(
    solver: Solver, stars: Stars, disc: Disc, seen: _Seen, tilt: Tilt, state: EarthState, stamp_s: float
) -> Solution:
    """The Sun's circle of equal altitude, with the Moon's in its stead; a glow is not the Moon's."""
    camera = solver.instrument.camera_for(stars.width, stars.height, stars.origin_px)
    up = solver.instrument.mounting.level(tilt).camera[2]
    across = (up - (up @ seen.ray) * seen.ray) / max(math.sqrt(1 - (up @ seen.ray) ** 2), MIN_SINE)
    lens = ErrorTerm("lens", (across @ seen.lens)[None], shared=ALWAYS)
    about = replace(solver.circumstances(stars, camera, state), stamp_stddev_s=stamp_s)

    def circle_of(name: str) -> Circle:
        body = body_at(name, state, solver.ephemeris)
        _check_size(disc, seen, body, camera, stars.place)
        sigma = math.hypot(float(np.linalg.norm(across @ seen.own)), body.sigma)
        circle = circle_along(
            seen.ray, body.itrs, stars.place, tilt, about, sigma=sigma, parallax=body.parallax
        )
        return replace(circle, terms=(*circle.terms, lens))

    circle = circle_of(SUN)
    if disc.sharp:
        with suppress(PlaceError):
            circle = replace(circle, instead=circle_of(MOON))
    name = "the Sun" if circle.instead is None else "the Sun, or the Moon,"
    text = f"{name} {math.degrees(circle.zenith_distance):.4f} deg from the zenith"
    return Solution.of(stars, text, circle=circle, tilt=tilt, bodies=(SUN,))


@dataclass(frozen=True, eq=False)
class _Adjusted:
    """An attitude by two directions, a body's and up, each in two components across it, of which one is superfluous.

    g (3, 3): C into east, north, up.  by_body, by_up (3, 2): its rotation for an error of a component of each.
    """

    g: np.ndarray
    by_body: np.ndarray
    by_up: np.ndarray


# change of up's components, towards east and north, by a small rotation
OF_UP = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])


@dataclass(frozen=True, eq=False)
class _TwoDirections:
    """A body seen where the level says it is, and where the ephemeris does; components are sideways and upwards.

    g (3, 3): C into east, north, up by the level and the body's azimuth.
    bent (3,): the body's direction as the ephemeris and the air have it, in east, north, up.
    components (2, 3): unit vectors across it.  turned (2, 3): its components' change by a small rotation.
    """

    g: np.ndarray
    bent: np.ndarray
    components: np.ndarray
    turned: np.ndarray

    @classmethod
    def of(cls, level: np.ndarray, ray: np.ndarray, bent: np.ndarray) -> "_TwoDirections | None":
        """level (3, 3): C into L.  None in the zenith, where there is no azimuth."""
        local, sine = level @ ray, math.hypot(bent[0], bent[1])
        if min(sine, math.hypot(local[0], local[1])) < MIN_SINE:
            return None
        turn = math.atan2(bent[1], bent[0]) - math.atan2(local[1], local[0])
        along = np.array([-bent[1], bent[0], 0.0]) / sine
        components = np.stack([along, np.cross(bent, along)])
        return cls(rotation.about_axis(2, turn) @ level, bent, components, np.cross(bent, components))

    def adjusted(self, ray: np.ndarray, of_body: np.ndarray, of_up: np.ndarray) -> tuple[_Adjusted, float]:
        """The attitude, and by how many sigma the altitudes differ; covariances (2, 2) of the components, rad2."""
        off = self.components @ (self.bent - self.g @ ray)
        # up that errs by a component moves the altitude
        altitude = self.turned[1] @ OF_UP.T
        sigma = math.sqrt(altitude @ of_up @ altitude + of_body[1, 1])
        body, up = self.turned.T @ np.linalg.inv(of_body), OF_UP.T @ np.linalg.inv(of_up)
        spread = np.linalg.inv(body @ self.turned + up @ OF_UP)
        g = rotation.from_vector(spread @ body @ off) @ self.g
        return _Adjusted(g, spread @ body, spread @ up), abs(float(off[1])) / sigma


def _attitude(
    solver: Solver,
    stars: Stars,
    disc: Disc,
    seen: _Seen,
    body: Body,
    tilt: Tilt,
    state: EarthState,
    place: Place,
    stamp_s: float,
) -> AttitudeAtPlace:
    """The attitude by the body's direction and the level; PlaceError if they contradict each other's altitude."""
    a4, air, mounting, name = (
        place.plumb_axes,
        solver.atmosphere,
        solver.instrument.mounting,
        body.name.title(),
    )
    clock_s, level = solver.clock_stddev_s(stars), mounting.level(tilt)
    true = a4 @ body.from_place(a4[2])
    if true[2] < LOWEST_SINE:
        raise PlaceError(
            f"{stars.place}: at this time and place the {name} is at an altitude of {_altitude_deg(true):.1f} deg, and a "
            "heading takes the whole disc above the horizon: the frame shows something else, or the clock or the place "
            "is wrong"
        )
    bent, raised = air.raised(true)
    two = _TwoDirections.of(level.camera, seen.ray, bent)
    if two is None:
        raise FixError(f"{stars.place}: the {name} is in the zenith, where it gives no heading")
    moved = zenith_moved(place.plumb[0])
    of_body = (
        ErrorTerm("disc", two.components @ two.g @ seen.own),
        ErrorTerm("lens", two.components @ two.g @ seen.lens, shared=ALWAYS),
        ErrorTerm("ephemeris", np.eye(2) * body.sigma, shared=ALWAYS),
        ErrorTerm("refraction", np.array([[0.0], [raised]]), shared=ALWAYS),
        *sky_terms(two.turned, state, clock_s, stamp_s, a4),
        ErrorTerm("place", two.turned @ moved @ place.zenith_root, shared=ALWAYS),
    )
    deflected = two.turned @ moved * place.plumb_stddev
    of_up = tilt_terms(OF_UP @ two.g @ level.camera.T, level, tilt, mounting, state.utc_unix_s)
    whole = total_covariance((*of_body, ErrorTerm("deflection", deflected)))
    found, sigmas = two.adjusted(seen.ray, whole, total_covariance(of_up))
    if sigmas > (LIMB_SIGMAS if disc.sharp else GLOW_SIGMAS):
        raise PlaceError(
            f"{stars.place}: by the level its bright disc is at an altitude of "
            f"{_altitude_deg(level.camera @ seen.ray):.2f} deg, and the {name} at {_altitude_deg(bent):.2f}, "
            f"{sigmas:.0f} times the stated errors away: it is not the {name}, or the clock, the place, the tilts or A3 "
            "are wrong"
        )
    terms = (
        *(replace(t, factor=found.by_body @ t.factor) for t in of_body),
        *(replace(t, factor=found.by_up @ t.factor) for t in of_up),
    )
    plumb = found.by_body @ deflected
    ellipsoid = plumb + moved * (place.ellipsoid_stddev - place.plumb_stddev)
    own = total_covariance(t for t in terms if not t.common)
    expected = found.g.T @ bent
    slope = seen.slope
    off_px = np.linalg.lstsq(slope, expected - seen.ray, rcond=None)[0]
    return AttitudeAtPlace(
        utc_unix_s=state.utc_unix_s,
        camera=Attitude(a4.T @ found.g, a4.T @ own @ a4, of=CAMERA, into=ITRS),
        stamp_stddev_s=stars.stamp_stddev_s,
        clock_stddev_s=clock_s,
        tilt=tilt,
        used=np.zeros(0, int),
        residual_px=off_px[None],
        residual_arcsec=math.dist(expected, seen.ray) / ARCSEC,
        jitter_px=0.0,
        focal_scale=1.0,
        zenith_distance=math.acos(min(max(bent[2], -1.0), 1.0)),
        refraction_arcsec=math.dist(bent, true) / ARCSEC,
        diurnal_aberration_arcsec=math.hypot(*station_velocity(a4[2])) / ARCSEC,
        ut1_minus_utc_s=state.orientation.ut1_minus_utc_s,
        place=place,
        **attitudes_at(place, found.g, mounting, terms, (plumb, ellipsoid)),
    )


def _altitude_deg(direction: np.ndarray) -> float:
    """Altitude of a direction (3,) whose third component points up."""
    return math.degrees(math.asin(min(max(direction[2], -1.0), 1.0)))

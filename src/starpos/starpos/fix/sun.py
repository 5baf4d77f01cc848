# SPDX-License-Identifier: Apache-2.0
"""The attitude by the Sun, or the Moon, and the level: at a known place, whose ephemeris says where the body stands.

Two directions make an attitude, the body's and the plumb line's. They contain the altitude twice: that excludes a
lamp, and makes the attitude better than by either. Without a place one frame gives a circle of equal altitude.
"""

import itertools
import math
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from starpos import rotation
from starpos._numeric.roots import symmetric_root
from starpos.earth.orientation import EarthState, earth_state, station_velocity
from starpos.earth.place import Place, Places
from starpos.earth.refraction import MIN_COS_ZENITH, Atmosphere
from starpos.errors import FixError, InstrumentError, PlaceError, StarposError
from starpos.fix.attitude import ANY_TURN, CAMERA, ITRS, Attitude, CameraAttitude, heading_of
from starpos.fix.budget import level_rows, local_north, mount_term, sky_rows, sky_terms, tilt_terms
from starpos.fix.checks import MIN_DEG, check_unmoved
from starpos.fix.circle import MIN_SINE, Circle, circle_along
from starpos.fix.fix import Fix
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
# of two discs the brighter is the Sun
BOTH: tuple[str, ...] = SUN, MOON
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
        sun, moon = (body_at(name, state, solver.ephemeris).itrs for name in BOTH)
        if not disc.sharp:
            sigma = float(np.linalg.norm(seen.own)) / math.sqrt(2)
            glow = Glow(state.utc_unix_s, seen.ray, sun, sigma)
        looked = partial(_looks, solver, stars, camera=camera, state=state)
        apart = bool(np.linalg.norm(sun - moon) > NEAREST)
        place = None if places is None else places.at(state.utc_unix_s)
        both: tuple[str, ...] = BOTH if disc.other is not None and apart else ()
        discs: tuple[Disc | None, ...] = disc, disc.other
        if not both and disc.sharp:
            both, discs = _with_planet(solver, stars, disc, looked, tilt, place, state, stamp_s)
        if place is None:
            if both:
                with suppress(PlaceError):
                    fix = _two_body_fix(solver, stars, looked(discs, both), tilt, state, stamp_s)
                    return Solution.of(stars, f"fix by {_named(both)}", fix=fix, tilt=tilt, bodies=both)
            return replace(_on_circle(solver, stars, disc, seen, tilt, state, stamp_s), glow=glow)
        wrong = []
        found: dict[tuple[str, ...], AttitudeAtPlace] = {}
        for names in itertools.chain((both,) * bool(both), ((SUN,), (MOON,))[: 1 + disc.sharp]):
            if both not in found:
                try:
                    found[names] = _attitude(solver, stars, looked(discs, names), tilt, state, place, stamp_s)
                except PlaceError as error:
                    wrong.append(error)
        if not found:
            raise wrong[bool(both)]
        (names, attitude), *others = found.items()
        if others and apart:
            raise FixError(
                f"{stars.place}: the Sun and the Moon stand equally high, and the disc may be either: wait some minutes"
            )
        return Solution.of(
            stars,
            f"{attitude.text}, by {_named(names)}",
            at_place=attitude,
            tilt=tilt,
            bodies=names,
            glow=None if names == BOTH else glow,
            extrapolated_days=state.orientation.extrapolated_days,
        )
    except StarposError as error:
        return replace(Solution.refused(stars, error), glow=glow)


def _named(names: tuple[str, ...]) -> str:
    return " and ".join(f"the {name.title()}" for name in names)


@dataclass(frozen=True, eq=False)
class _Look:
    """A disc as it is seen, and the body that it is taken for.  sharp: whether its limb was fitted."""

    seen: _Seen
    body: Body
    sharp: bool

    def terms(self, across: np.ndarray, bent: np.ndarray) -> tuple[ErrorTerm, ...]:
        """Errors of two components of the direction; across (2, 3): these in C.  bent (2,): by 1 sigma of refraction."""
        return (
            ErrorTerm("disc", across @ self.seen.own),
            ErrorTerm("lens", across @ self.seen.lens, shared=ALWAYS),
            ErrorTerm("ephemeris", np.eye(2) * self.body.sigma, shared=ALWAYS),
            ErrorTerm("refraction", bent[:, None], shared=ALWAYS),
        )


def _looks(
    solver: Solver,
    stars: Stars,
    discs: Sequence[Disc | None],
    names: tuple[str, ...],
    *,
    camera: Camera,
    state: EarthState,
) -> list[_Look]:
    """The discs of a frame as these bodies; PlaceError if one is of another size."""
    found = []
    for name, one in zip(names, discs, strict=False):
        assert one is not None
        seen, body = _Seen.of(one, camera, stars.place), body_at(name, state, solver.ephemeris)
        if name in BOTH:
            # where the Moon stands as it must from a glow, that is no lamp
            _check_size(one, seen, body, camera, stars.place, alone=names != BOTH)
        else:
            # its light comes from a part of its disc
            body = replace(body, sigma=math.hypot(body.sigma, body.radius))
        found.append(_Look(seen, body, one.sharp))
    return found


# A second body is where it must be to this many sigma.  So near the Sun, rad, the Moon is a crescent that is not seen: a
# second disc is a ghost.
SECOND_SIGMAS, NEAREST = 5.0, math.radians(15.0)
PARALLAX_ROUNDS = 6
# Planets that are seen by day.  Number of a frame's brightest points that may be one, and the chance at which one of them
# is as far from the disc by accident: by a grid of pixels, in a band of rad on both sides.
BY_DAY = "venus", "jupiter"
POINTS, CHANCE, GRID, BAND = 3, 5e-3, 60, math.radians(3.0)
# of errors that are each body's own; all others have one cause for all
EACH_ITS_OWN = ("disc", "ephemeris")


def _of_all(by: Sequence[np.ndarray], terms: Sequence[tuple[ErrorTerm, ...]]) -> list[ErrorTerm]:
    """The terms of several directions, the same ones of each; by (r, 2): the factors' rows for its components."""
    found = []
    for of_each in zip(*terms, strict=True):
        parts = [row @ term.factor for row, term in zip(by, of_each, strict=True)]
        whole = np.hstack(parts) if of_each[0].name in EACH_ITS_OWN else np.sum(parts, 0)
        found.append(replace(of_each[0], factor=whole))
    return found


@dataclass(frozen=True, eq=False, kw_only=True)
class _Between:
    """Two bodies under a level, put into the sky as well as their distance goes.

    raised, there, sky (2, 3): as they are seen, without air, and where they stand; variances (2,) rad2.
    a4 (3, 3): ITRS into the level's axes.  sigma (rad): of their distance on the frame and in the sky.
    """

    raised: np.ndarray
    there: np.ndarray
    sky: np.ndarray
    variances: np.ndarray
    a4: np.ndarray
    sigma: float

    @classmethod
    def of(cls, looks: list[_Look], g: np.ndarray, air: Atmosphere, frame: str) -> "_Between":
        """Fit both bodies; g (3, 3): C into the level's axes.  PlaceError for bodies too low."""
        raised = np.array([g @ look.seen.ray for look in looks])
        if raised[:, 2].min() < MIN_COS_ZENITH:
            raise PlaceError(f"{frame}: by the level one of its two bodies is below {MIN_DEG:.0f} deg")
        there = air.refraction().unbend(raised)
        bodies, seen = [look.body for look in looks], [look.seen for look in looks]
        variances = np.array(
            [np.sum(s.own**2) / 2 + np.sum(s.lens**2) + b.sigma**2 for s, b in zip(seen, bodies, strict=True)]
        )
        sky = np.array([b.itrs for b in bodies])
        a4 = rotation.best_rotation(sky, there, 1 / variances)
        # the Moon's parallax follows the zenith, of which it is a sixtieth
        for _ in range(PARALLAX_ROUNDS):
            sky = np.array([b.from_place(a4[2]) for b in bodies])
            a4 = rotation.best_rotation(sky, there, 1 / variances)
        # each direction's errors along the line to the other; the lens's have one cause
        along = np.array([s.ray for s in seen[::-1]]) / np.linalg.norm(np.cross(seen[0].ray, seen[1].ray))
        errors = [row @ s.own for row, s in zip(along, seen, strict=True)]
        lens = sum(row @ s.lens for row, s in zip(along, seen, strict=True))
        sigma = np.linalg.norm(np.concatenate([*errors, lens, [b.sigma for b in bodies]]))
        return cls(raised=raised, there=there, sky=sky, variances=variances, a4=a4, sigma=float(sigma))

    @property
    def angles(self) -> tuple[float, float]:
        """How far they are apart on the frame and in the sky, rad."""
        seen, true = (2 * math.asin(math.dist(*v) / 2) for v in (self.there, self.sky))
        return seen, true

    @property
    def agree(self) -> bool:
        """Whether these two angles are the same, to their error."""
        return abs(self.angles[0] - self.angles[1]) < SECOND_SIGMAS * self.sigma


def _with_planet(
    solver: Solver,
    stars: Stars,
    disc: Disc,
    looked: Callable[[Sequence[Disc | None], tuple[str, ...]], list[_Look]],
    tilt: Tilt,
    place: Place | None,
    state: EarthState,
    stamp_s: float,
) -> tuple[tuple[str, ...], tuple[Disc, ...]]:
    """The disc's body and a planet, with the disc and the bright point that is one; nothing where it may be none.

    A point agrees by its distance from the disc, and at a known place by its altitude.  The chance that another one would
    counts every point as every planet, by the share of the frame's pixels that are as far and as high.
    """
    points = [
        Disc(x=x, y=y, covariance=covariance, radius_px=0.0, sharp=True)
        for x, y, covariance, _ in zip(stars.x, stars.y, stars.covariance, range(POINTS), strict=False)
    ]
    camera = solver.instrument.camera_for(stars.width, stars.height, stars.origin_px)
    mounting = solver.instrument.mounting
    level = mounting.level(tilt)
    pixels = (np.arange(GRID) + 0.5) / GRID
    x, y = (part.ravel() for part in np.meshgrid(pixels * stars.width, pixels * stars.height))
    rays = camera.directions(x, y)
    found, shares = [], 0.0
    for names, point in itertools.product(itertools.product(BOTH, BY_DAY), points):
        with suppress(PlaceError, FixError):
            looks = looked((disc, point), names)
            pair = _Between.of(looks, level.camera, solver.atmosphere, stars.place)
            seen, true = pair.angles
            near = np.abs(np.arccos(np.clip(rays @ looks[0].seen.ray, -1, 1)) - true) < BAND
            off, sigma = np.array([seen - true]), np.array([pair.sigma])
            if place is not None:
                sighted = _Sighted.of(solver, stars, looks[1], level.camera, place, state, stamp_s)
                of_level = tilt_terms(sighted.turn[1:], level, tilt, mounting, state.utc_unix_s)
                variance = total_covariance(sighted.terms)[1, 1] + total_covariance(of_level)[0, 0]
                altitude = math.asin(sighted.bent[2])
                off = np.append(off, math.asin(pair.raised[1, 2]) - altitude)
                sigma = np.append(sigma, variance**0.5)
                near &= np.abs(np.arcsin(rays @ level.camera[2]) - altitude) < BAND
            shares += float(np.mean(near))
            if (np.abs(off) < SECOND_SIGMAS * sigma).all():
                found.append((float(np.prod(np.maximum(np.abs(off), sigma) / BAND)), names, point))
    sound = [(names, (disc, point)) for part, names, point in found if part * shares < CHANCE]
    return sound[0] if len(sound) == 1 else ((), (disc,))


def _two_body_fix(
    solver: Solver, stars: Stars, looks: list[_Look], tilt: Tilt, state: EarthState, stamp_s: float
) -> Fix:
    """Place and attitude by two bodies and the level; PlaceError if they are not as far apart as they must be."""
    camera = solver.instrument.camera_for(stars.width, stars.height, stars.origin_px)
    about = solver.circumstances(stars, camera, state)
    mounting, air = about.mounting, about.atmosphere
    level = mounting.level(tilt)
    g = level.camera
    pair = _Between.of(looks, g, air, stars.place)
    raised, there, variances, a4 = pair.raised, pair.there, pair.variances, pair.a4
    off = there - pair.sky @ a4.T
    if not pair.agree:
        seen_deg, true_deg = np.degrees(pair.angles)
        names = _named(tuple(k.body.name for k in looks))
        raise PlaceError(
            f"{stars.place}: its two bright discs are {seen_deg:.2f} deg apart, and {names} {true_deg:.2f}"
        )
    across = [_across(v) for v in there]
    turned = [np.cross(v, c) for v, c in zip(there, across, strict=True)]
    spread = np.linalg.inv(sum(t.T @ t / v for t, v in zip(turned, variances, strict=True)))
    by = [spread @ t.T / v for t, v in zip(turned, variances, strict=True)]
    place = local_north(a4)
    link_to_enu = place.local_to_enu @ g @ mounting.link_to_camera
    of_sky, of_level = sky_rows(place), level_rows(place, link_to_enu)
    of_bodies = [
        k.terms(c @ g, c @ (seen - v) * air.relative_sigma)
        for k, c, v, seen in zip(looks, across, there, raised, strict=True)
    ]
    terms = (
        *_of_all([of_sky @ row for row in by], of_bodies),
        *tilt_terms(of_level, level, tilt, mounting, state.utc_unix_s),
        *sky_terms(of_sky, state, about.clock_stddev_s, stamp_s, a4),
        *mount_term("mount", link_to_enu, mounting.link_stddev_rad),
    )
    own = total_covariance(_of_all(by, [terms[:1] for terms in of_bodies]))
    axes = rotation.shortest_turn(np.array([0.0, 0.0, 1.0]), level.up)[:, :2]
    fix = Fix(
        **_fields(stars, state, tilt, about.clock_stddev_s, a4, g, own),
        residual_arcsec=math.sqrt(float(np.mean(off**2))) / ARCSEC,
        zenith_distance=math.acos(min(max(float(g[2] @ camera.centre_ray), -1.0), 1.0)),
        refraction_arcsec=math.dist(raised[0], there[0]) / ARCSEC,
        latitude=place.latitude,
        longitude=place.longitude,
        heading=heading_of(link_to_enu),
        link_to_enu=link_to_enu,
        terms=terms,
        levelling=of_level @ (level.turns @ axes),
    )
    check_unmoved(fix, solver.instrument)
    return fix


def _fields(
    stars: Stars,
    state: EarthState,
    tilt: Tilt,
    clock_s: float,
    a4: np.ndarray,
    g: np.ndarray,
    own: np.ndarray,
) -> dict[str, Any]:
    """Fields of a FittedSighting without stars; g (3, 3): C into L, own (3, 3): covariance of the frame's own errors."""
    return {
        "utc_unix_s": state.utc_unix_s,
        "camera": Attitude(a4.T @ g, a4.T @ own @ a4, of=CAMERA, into=ITRS),
        "stamp_stddev_s": stars.stamp_stddev_s,
        "clock_stddev_s": clock_s,
        "tilt": tilt,
        "used": np.zeros(0, int),
        "residual_px": np.zeros((0, 2)),
        "jitter_px": 0.0,
        "focal_scale": 1.0,
        "diurnal_aberration_arcsec": math.hypot(*station_velocity(a4[2])) / ARCSEC,
        "ut1_minus_utc_s": state.orientation.ut1_minus_utc_s,
    }


def _across(direction: np.ndarray) -> np.ndarray:
    """Unit vectors (2, 3) across a direction (3,): sideways and upwards."""
    along = np.array([-direction[1], direction[0], 0.0]) / math.hypot(direction[0], direction[1])
    return np.stack([along, np.cross(direction, along)])


def _check_size(disc: Disc, seen: _Seen, body: Body, camera: Camera, place: str, alone: bool = True) -> None:
    """Raise PlaceError if a disc is not as wide as the body."""
    if alone and not disc.sharp and body.radius * disc.radius_px > RESOLVED_PX * seen.radius:
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


# change of up's components, towards east and north, by a small rotation
OF_UP = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])


def _attitude(
    solver: Solver,
    stars: Stars,
    looks: list[_Look],
    tilt: Tilt,
    state: EarthState,
    place: Place,
    stamp_s: float,
) -> AttitudeAtPlace:
    """The attitude by directions of bodies and the level, each in two components; PlaceError if they contradict."""
    a4, air, mounting = place.plumb_axes, solver.atmosphere, solver.instrument.mounting
    level, moved = mounting.level(tilt), zenith_moved(place.plumb[0])
    first = looks[0]
    bent = _seen_from(first.body, air, a4, stars.place)[0]
    local = level.camera @ first.seen.ray
    if min(math.hypot(*bent[:2]), math.hypot(*local[:2])) < MIN_SINE:
        raise FixError(
            f"{stars.place}: the {first.body.name.title()} is in the zenith, where it gives no heading"
        )
    # by the level and the first body's azimuth
    g = rotation.about_axis(2, math.atan2(bent[1], bent[0]) - math.atan2(local[1], local[0])) @ level.camera
    of_up = tilt_terms(OF_UP @ g @ level.camera.T, level, tilt, mounting, state.utc_unix_s)
    up = OF_UP.T @ np.linalg.inv(total_covariance(of_up))
    normal, found = up @ OF_UP, g
    weighted: list[np.ndarray] = []
    of_bodies: list[tuple[ErrorTerm, ...]] = []
    off_px = []
    for look in looks:
        sighted = _Sighted.of(solver, stars, look, g, place, state, stamp_s)
        bent, components, turn, of_body = sighted.bent, sighted.components, sighted.turn, sighted.terms
        whole = total_covariance(of_body)
        off = components @ (bent - found @ look.seen.ray)
        # what is known already has no azimuth until there is a body
        known = turn @ np.linalg.pinv(normal) @ turn.T
        share = slice(None) if weighted else slice(1, 2)
        sigmas = math.sqrt(off[share] @ np.linalg.solve((whole + known)[share, share], off[share]))
        if sigmas > (LIMB_SIGMAS if look.sharp else GLOW_SIGMAS):
            name, seen = look.body.name.title(), found @ look.seen.ray
            raise PlaceError(
                f"{stars.place}: by the level its bright disc is at an altitude of {_altitude_deg(seen):.2f} deg, and "
                f"the {name} at {_altitude_deg(bent):.2f}, {sigmas:.0f} times the stated errors away: it is not the "
                f"{name}, or the clock, the place, the tilts or A3 are wrong"
            )
        weight = turn.T @ np.linalg.inv(whole)
        normal = normal + weight @ turn
        found = rotation.from_vector(np.linalg.solve(normal, weight @ off)) @ found
        weighted.append(weight)
        of_bodies.append(of_body)
        expected, slope = found.T @ bent, look.seen.slope
        off_px.append(np.linalg.lstsq(slope, expected - look.seen.ray, rcond=None)[0])
    spread = np.linalg.inv(normal)
    *of_sky, deflected = _of_all([spread @ weight for weight in weighted], of_bodies)
    terms = (*of_sky, *(replace(t, factor=spread @ up @ t.factor) for t in of_up))
    plumb = deflected.factor
    ellipsoid = plumb + moved * (place.ellipsoid_stddev - place.plumb_stddev)
    own = total_covariance(t for t in terms if not t.common)
    return AttitudeAtPlace(
        **_fields(stars, state, tilt, solver.clock_stddev_s(stars), a4, found, own)
        | {"residual_px": np.array(off_px)},
        residual_arcsec=math.dist(expected, looks[-1].seen.ray) / ARCSEC,
        zenith_distance=math.acos(min(max(bent[2], -1.0), 1.0)),
        refraction_arcsec=math.dist(bent, sighted.true) / ARCSEC,
        place=place,
        **attitudes_at(place, found, mounting, terms, (plumb, ellipsoid)),
    )


@dataclass(frozen=True, eq=False)
class _Sighted:
    """A body over a known place, bent (3,) as it is seen and true (3,) without air, along east, north and up.

    components (2, 3): across it, sideways and upwards; turn (2, 3): their change by a small rotation.
    terms: errors of them.
    """

    bent: np.ndarray
    true: np.ndarray
    components: np.ndarray
    turn: np.ndarray
    terms: tuple[ErrorTerm, ...]

    @classmethod
    def of(
        cls,
        solver: Solver,
        stars: Stars,
        look: _Look,
        g: np.ndarray,
        place: Place,
        state: EarthState,
        stamp_s: float,
    ) -> "_Sighted":
        """Return the body over its place; g (3, 3): C into axes whose third is up."""
        a4, moved = place.plumb_axes, zenith_moved(place.plumb[0])
        bent, raised, true = _seen_from(look.body, solver.atmosphere, a4, stars.place)
        components, local = _across(bent), g @ look.seen.ray
        g = rotation.about_axis(2, math.atan2(bent[1], bent[0]) - math.atan2(local[1], local[0])) @ g
        turn = np.cross(bent, components)
        terms = (
            *look.terms(components @ g, np.array([0.0, raised])),
            *sky_terms(turn, state, solver.clock_stddev_s(stars), stamp_s, a4),
            ErrorTerm("place", turn @ moved @ place.zenith_root, shared=ALWAYS),
            ErrorTerm("deflection", turn @ moved * place.plumb_stddev, shared=ALWAYS),
        )
        return cls(bent, true, components, turn, terms)


def _seen_from(
    body: Body, air: Atmosphere, a4: np.ndarray, frame: str
) -> tuple[np.ndarray, float, np.ndarray]:
    """A body's direction (3,) in the air over a place, the error of its altitude, and its direction without air.

    PlaceError below the horizon.
    """
    true, name = a4 @ body.from_place(a4[2]), body.name.title()
    if true[2] < LOWEST_SINE:
        raise PlaceError(
            f"{frame}: at this time and place the {name} is at an altitude of {_altitude_deg(true):.1f} deg, and a "
            "heading takes the whole disc above the horizon: the frame shows something else, or the clock or the place "
            "is wrong"
        )
    return *air.raised(true), true


def _altitude_deg(direction: np.ndarray) -> float:
    """Altitude of a direction (3,) whose third component points up."""
    return math.degrees(math.asin(min(max(direction[2], -1.0), 1.0)))

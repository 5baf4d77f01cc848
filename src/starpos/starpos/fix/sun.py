# SPDX-License-Identifier: Apache-2.0
"""The attitude by the Sun, or the Moon, and the level: at a known place, whose ephemeris says where the body stands.

Two directions make an attitude, the body's and the plumb line's. They contain the altitude twice: that excludes a
lamp, and makes the attitude better than by either. Without a place one frame gives a circle of equal altitude.
"""

import itertools
import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from starpos import rotation
from starpos._numeric.roots import symmetric_root
from starpos.earth.orientation import EarthState, earth_state
from starpos.earth.place import Place, Places
from starpos.earth.refraction import MIN_COS_ZENITH
from starpos.errors import FixError, InstrumentError, PlaceError, StarposError
from starpos.fix.attitude import ANY_TURN, CameraAttitude
from starpos.fix.budget import Circumstances, sky_terms, tilt_terms
from starpos.fix.checks import MIN_DEG, check_unmoved
from starpos.fix.circle import MIN_SINE, Circle, circle_along
from starpos.fix.directions import axes_across
from starpos.fix.fix import Fix, levelled_fix
from starpos.fix.glows import Glow
from starpos.fix.heading import AttitudeAtPlace, attitudes_at, zenith_moved
from starpos.fix.sighting import seen_fields
from starpos.fix.solution import Solution
from starpos.fix.solver import Solver
from starpos.fix.terms import ALWAYS, ErrorTerm, total_covariance
from starpos.frames.frame import Disc, Stars
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
class _Shot:
    """A frame by day; about: its circumstances when the row of its disc was exposed, with the error of that time."""

    solver: Solver
    stars: Stars
    about: Circumstances

    @classmethod
    def of(cls, solver: Solver, stars: Stars, disc: Disc, state: EarthState) -> "_Shot":
        shutter, row = solver.shutter(stars), np.array([disc.y])
        if late_s := float(shutter.later_s(row, stars.height)[0]):
            state = earth_state(state.utc_unix_s + late_s)
        camera = solver.instrument.camera_for(stars.width, stars.height, stars.origin_px)
        stamp_s = math.hypot(stars.stamp_stddev_s, *shutter.errors_s(row, stars.height)[0].tolist())
        return cls(solver, stars, replace(solver.circumstances(stars, camera, state), stamp_stddev_s=stamp_s))

    def look(self, disc: Disc, name: str) -> "_Look":
        """The disc, or the bright point, as this body."""
        x, y, r, camera = disc.x, disc.y, disc.radius_px, self.about.camera
        rays = camera.directions(x + np.array([0, 1, 0, r, -r, 0, 0]), y + np.array([0, 0, 1, 0, 0, r, -r]))
        ray = rays[0]
        if not np.isfinite(rays).all():
            raise FixError(
                f"{self.stars.place}: the bright disc lies at the rim of the lens's picture: turn the camera"
            )
        slope = (rays[1:3] - ray).T
        off_axis = np.array([x - camera.cx, y - camera.cy])
        body = body_at(name, self.about.earth, self.solver.ephemeris)
        if name not in BOTH:
            # its light comes from a part of its disc
            body = replace(body, sigma=math.hypot(body.sigma, body.radius))
        return _Look(
            shot=self,
            disc=disc,
            body=body,
            ray=ray,
            slope=slope,
            own=slope @ symmetric_root(disc.covariance),
            lens=slope @ off_axis[:, None] * LENS_SHARE,
            radius=float(np.arccos(np.clip(rays[3:] @ ray, -1, 1)).mean()),
        )

    def looks(self, discs: Sequence[Disc], names: tuple[str, ...]) -> "list[_Look]":
        """The discs as these bodies; PlaceError if one is of another size."""
        found = [self.look(disc, name) for name, disc in zip(names, discs, strict=False)]
        for look in found:
            if look.body.name in BOTH:
                # where the Moon stands as it must from a glow, that is no lamp
                look.check_size(alone=names != BOTH)
        return found


@dataclass(frozen=True, eq=False, kw_only=True)
class _Look:
    """A disc as a direction, and the body that it is taken for.

    ray (3,) in C, its change slope (3, 2) by a px, and the disc's radius, rad.
    own (3, 2), lens (3, 1): errors of the ray in rad, new in each frame and of the lens.
    """

    shot: _Shot
    disc: Disc
    body: Body
    ray: np.ndarray
    slope: np.ndarray
    own: np.ndarray
    lens: np.ndarray
    radius: float

    def terms(self, across: np.ndarray, bent: np.ndarray) -> tuple[ErrorTerm, ...]:
        """Errors of two components of the direction; across (2, 3): these in C.  bent (2,): by 1 sigma of refraction."""
        return (
            ErrorTerm("disc", across @ self.own),
            ErrorTerm("lens", across @ self.lens, shared=ALWAYS),
            ErrorTerm("ephemeris", np.eye(2) * self.body.sigma, shared=ALWAYS),
            ErrorTerm("refraction", bent[:, None], shared=ALWAYS),
        )

    def check_size(self, alone: bool = True) -> None:
        """Raise PlaceError if the disc is not as wide as the body; alone: no second one shows that it is no lamp."""
        disc, body, place = self.disc, self.body, self.shot.stars.place
        if alone and not disc.sharp and body.radius * disc.radius_px > RESOLVED_PX * self.radius:
            raise PlaceError(
                f"{place}: a bright spot without a limb, in a lens that shows the Sun's: it is a lamp or a cloud, or the "
                "Sun without a filter, behind which alone such a lens may look at it"
            )
        if disc.sharp:
            off = abs(self.radius / body.radius - 1) > SIZE_SHARE + SIZE_PX / disc.radius_px
        else:
            off = not body.radius * (1 - SIZE_PX / disc.radius_px) < self.radius < WIDEST_GLOW
        if off:
            name = body.name.title()
            raise PlaceError(
                f"{place}: its bright disc is {math.degrees(2 * self.radius):.2f} deg wide and the {name} "
                f"{math.degrees(2 * body.radius):.2f}: it is not the {name}, or the focal length "
                f"({self.shot.about.camera.fx:.0f} px) is wrong"
            )


def sun_alone(solver: Solver, stars: Stars, disc: Disc, frame_id: str) -> CameraAttitude | None:
    """The attitude of a frame that shows the Sun, but for the turn about it; None for a disc of another size."""
    if stars.mid_unix_s is None:
        return None
    try:
        look = _Shot.of(solver, stars, disc, earth_state(stars.mid_unix_s)).look(disc, SUN)
        look.check_size()
    except StarposError:
        return None
    about, ray = look.shot.about, look.ray
    if ray[2] <= 0:
        return None
    own = np.column_stack([look.own, look.lens, np.eye(3) * look.body.sigma])
    turns = np.cross(ray, own.T)
    return CameraAttitude(
        utc_unix_s=about.earth.utc_unix_s,
        stamp_stddev_s=about.stamp_stddev_s,
        clock_stddev_s=about.clock_stddev_s,
        frame_id=frame_id,
        camera_to_gcrs=rotation.shortest_turn(ray, about.earth.gcrs_to_itrs.T @ look.body.itrs),
        covariance=turns.T @ turns + ANY_TURN * np.outer(ray, ray),
        stars=0,
        log_odds=0.0,
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
        shot = _Shot.of(solver, stars, disc, state)
        state, as_sun = shot.about.earth, shot.look(disc, SUN)
        if not disc.sharp:
            sigma = float(np.linalg.norm(as_sun.own)) / math.sqrt(2)
            glow = Glow(state.utc_unix_s, as_sun.ray, as_sun.body.itrs, sigma)
        moon = body_at(MOON, state, solver.ephemeris)
        apart = bool(np.linalg.norm(as_sun.body.itrs - moon.itrs) > NEAREST)
        place = None if places is None else places.at(state.utc_unix_s)
        both: tuple[str, ...] = ()
        discs: tuple[Disc, ...] = (disc,)
        if disc.other is not None and apart:
            both, discs = BOTH, (disc, disc.other)
        elif disc.sharp:
            both, discs = _with_planet(shot, disc, tilt, place)
        if place is None:
            if both:
                with suppress(PlaceError):
                    fix = _two_body_fix(shot.looks(discs, both), tilt)
                    return Solution.of(stars, f"fix by {_named(both)}", fix=fix, tilt=tilt, bodies=both)
            return replace(_on_circle(as_sun, tilt), glow=glow)
        wrong = []
        found: dict[tuple[str, ...], AttitudeAtPlace] = {}
        for names in itertools.chain((both,) * bool(both), ((SUN,), (MOON,))[: 1 + disc.sharp]):
            if both not in found:
                try:
                    found[names] = _attitude(shot.looks(discs, names), tilt, place)
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
    def of(cls, looks: list[_Look], g: np.ndarray) -> "_Between":
        """Fit both bodies; g (3, 3): C into the level's axes.  PlaceError for bodies too low."""
        shot = looks[0].shot
        raised = np.array([g @ look.ray for look in looks])
        if raised[:, 2].min() < MIN_COS_ZENITH:
            raise PlaceError(
                f"{shot.stars.place}: by the level one of its two bodies is below {MIN_DEG:.0f} deg"
            )
        there = shot.about.atmosphere.refraction().unbend(raised)
        variances = np.array([np.sum(k.own**2) / 2 + np.sum(k.lens**2) + k.body.sigma**2 for k in looks])
        sky = np.array([look.body.itrs for look in looks])
        a4 = rotation.best_rotation(sky, there, 1 / variances)
        # the Moon's parallax follows the zenith, of which it is a sixtieth
        for _ in range(PARALLAX_ROUNDS):
            sky = np.array([look.body.from_place(a4[2]) for look in looks])
            a4 = rotation.best_rotation(sky, there, 1 / variances)
        # each direction's errors along the line to the other; the lens's have one cause
        rays = np.array([look.ray for look in looks])
        along = rays[::-1] / np.linalg.norm(np.cross(*rays))
        errors = [row @ look.own for row, look in zip(along, looks, strict=True)]
        lens = sum(row @ look.lens for row, look in zip(along, looks, strict=True))
        sigma = np.linalg.norm(np.concatenate([*errors, lens, [look.body.sigma for look in looks]]))
        return cls(raised=raised, there=there, sky=sky, variances=variances, a4=a4, sigma=float(sigma))

    @property
    def angles(self) -> tuple[float, float]:
        """How far they are apart on the frame and in the sky, rad."""
        seen, true = (2 * math.asin(math.dist(*v) / 2) for v in (self.there, self.sky))
        return seen, true


def _with_planet(
    shot: _Shot, disc: Disc, tilt: Tilt, place: Place | None
) -> tuple[tuple[str, ...], tuple[Disc, ...]]:
    """The disc's body and a planet, with the disc and the bright point that is one; nothing where it may be none.

    A point agrees by its distance from the disc, and at a known place by its altitude.  The chance that another one would
    counts every point as every planet, by the share of the frame's pixels that are as far and as high.
    """
    stars, about = shot.stars, shot.about
    points = [
        Disc(x=x, y=y, covariance=covariance, radius_px=0.0, sharp=True)
        for x, y, covariance, _ in zip(stars.x, stars.y, stars.covariance, range(POINTS), strict=False)
    ]
    level = about.instrument.level(tilt)
    pixels = (np.arange(GRID) + 0.5) / GRID
    x, y = (part.ravel() for part in np.meshgrid(pixels * stars.width, pixels * stars.height))
    rays = about.camera.directions(x, y)
    found, shares = [], 0.0
    for names, point in itertools.product(itertools.product(BOTH, BY_DAY), points):
        with suppress(PlaceError, FixError):
            looks = shot.looks((disc, point), names)
            pair = _Between.of(looks, level.camera)
            seen, true = pair.angles
            near = np.abs(np.arccos(np.clip(rays @ looks[0].ray, -1, 1)) - true) < BAND
            off, sigma = np.array([seen - true]), np.array([pair.sigma])
            if place is not None:
                planet = _Above.of(looks[1], level.camera, place)
                of_level = tilt_terms(planet.turn[1:], level, tilt, about.instrument, about.earth.utc_unix_s)
                variance = total_covariance(planet.terms)[1, 1] + total_covariance(of_level)[0, 0]
                altitude = math.asin(planet.bent[2])
                off = np.append(off, math.asin(pair.raised[1, 2]) - altitude)
                sigma = np.append(sigma, variance**0.5)
                near &= np.abs(np.arcsin(rays @ level.camera[2]) - altitude) < BAND
            shares += float(np.mean(near))
            if (np.abs(off) < SECOND_SIGMAS * sigma).all():
                found.append((float(np.prod(np.maximum(np.abs(off), sigma) / BAND)), names, point))
    sound = [(names, (disc, point)) for part, names, point in found if part * shares < CHANCE]
    return sound[0] if len(sound) == 1 else ((), (disc,))


def _two_body_fix(looks: list[_Look], tilt: Tilt) -> Fix:
    """Place and attitude by two bodies and the level; PlaceError if they are not as far apart as they must be."""
    shot = looks[0].shot
    about, level = shot.about, shot.about.instrument.level(tilt)
    g = level.camera
    pair = _Between.of(looks, g)
    raised, there, variances, a4 = pair.raised, pair.there, pair.variances, pair.a4
    seen, true = pair.angles
    if not abs(seen - true) < SECOND_SIGMAS * pair.sigma:
        names = _named(tuple(k.body.name for k in looks))
        raise PlaceError(
            f"{shot.stars.place}: its two bright discs are {math.degrees(seen):.2f} deg apart, and {names} "
            f"{math.degrees(true):.2f}"
        )
    across = axes_across(there)
    turned = [np.cross(v, c) for v, c in zip(there, across, strict=True)]
    spread = np.linalg.inv(sum(t.T @ t / v for t, v in zip(turned, variances, strict=True)))
    by = [spread @ t.T / v for t, v in zip(turned, variances, strict=True)]
    of_bodies = [
        k.terms(c @ g, c @ (seen - v) * about.atmosphere.relative_sigma)
        for k, c, v, seen in zip(looks, across, there, raised, strict=True)
    ]
    own = total_covariance(_of_all(by, [terms[:1] for terms in of_bodies]))

    def terms_of(rows: np.ndarray) -> tuple[list[ErrorTerm], list[ErrorTerm]]:
        terms = _of_all([rows @ row for row in by], of_bodies)
        return terms[:2], terms[2:]

    fix = levelled_fix(
        seen_fields(about, g, a4, own)
        | {"residual_arcsec": math.sqrt(float(np.mean((there - pair.sky @ a4.T) ** 2))) / ARCSEC},
        a4,
        level,
        tilt,
        about,
        terms_of,
    )
    check_unmoved(fix, shot.solver.instrument)
    return fix


def _on_circle(as_sun: _Look, tilt: Tilt) -> Solution:
    """The Sun's circle of equal altitude, with the Moon's in its stead; a glow is not the Moon's."""
    shot, ray, disc = as_sun.shot, as_sun.ray, as_sun.disc
    up = shot.about.instrument.level(tilt).camera[2]
    across = (up - (up @ ray) * ray) / max(math.sqrt(1 - (up @ ray) ** 2), MIN_SINE)
    lens = ErrorTerm("lens", (across @ as_sun.lens)[None], shared=ALWAYS)

    def circle_of(look: _Look) -> Circle:
        look.check_size()
        body, sigma = look.body, math.hypot(float(np.linalg.norm(across @ look.own)), look.body.sigma)
        circle = circle_along(
            ray, body.itrs, shot.stars.place, tilt, shot.about, sigma=sigma, parallax=body.parallax
        )
        return replace(circle, terms=(*circle.terms, lens))

    circle = circle_of(as_sun)
    if disc.sharp:
        with suppress(PlaceError):
            circle = replace(circle, instead=circle_of(shot.look(disc, MOON)))
    name = "the Sun" if circle.instead is None else "the Sun, or the Moon,"
    text = f"{name} {math.degrees(circle.zenith_distance):.4f} deg from the zenith"
    return Solution.of(shot.stars, text, circle=circle, tilt=tilt, bodies=(SUN,))


# change of up's components, towards east and north, by a small rotation
OF_UP = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])


def _attitude(looks: list[_Look], tilt: Tilt, place: Place) -> AttitudeAtPlace:
    """The attitude by directions of bodies and the level, each in two components; PlaceError if they contradict."""
    about, frame = looks[0].shot.about, looks[0].shot.stars.place
    instrument = about.instrument
    level, moved = instrument.level(tilt), zenith_moved(place.plumb[0])
    first, local = _Above.of(looks[0], level.camera, place), level.camera @ looks[0].ray
    if min(math.hypot(*first.bent[:2]), math.hypot(*local[:2])) < MIN_SINE:
        raise FixError(
            f"{frame}: the {looks[0].body.name.title()} is in the zenith, where it gives no heading"
        )
    found = g = first.g
    of_up = tilt_terms(OF_UP @ g @ level.camera.T, level, tilt, instrument, about.earth.utc_unix_s)
    up = OF_UP.T @ np.linalg.inv(total_covariance(of_up))
    normal = up @ OF_UP
    weighted: list[np.ndarray] = []
    of_bodies: list[tuple[ErrorTerm, ...]] = []
    off_px = []
    for look in looks:
        there = _Above.of(look, g, place)
        turn, whole = there.turn, total_covariance(there.terms)
        off = there.components @ (there.bent - found @ look.ray)
        # what is known already has no azimuth until there is a body
        known = turn @ np.linalg.pinv(normal) @ turn.T
        share = slice(None) if weighted else slice(1, 2)
        sigmas = math.sqrt(off[share] @ np.linalg.solve((whole + known)[share, share], off[share]))
        if sigmas > (LIMB_SIGMAS if look.disc.sharp else GLOW_SIGMAS):
            name, seen = look.body.name.title(), found @ look.ray
            raise PlaceError(
                f"{frame}: by the level its bright disc is at an altitude of {_altitude_deg(seen):.2f} deg, and the "
                f"{name} at {_altitude_deg(there.bent):.2f}, {sigmas:.0f} times the stated errors away: it is not the "
                f"{name}, or the clock, the place, the tilts or A3 are wrong"
            )
        weight = turn.T @ np.linalg.inv(whole)
        normal = normal + weight @ turn
        found = rotation.from_vector(np.linalg.solve(normal, weight @ off)) @ found
        weighted.append(weight)
        of_bodies.append(there.terms)
        expected = found.T @ there.bent
        off_px.append(np.linalg.lstsq(look.slope, expected - look.ray, rcond=None)[0])
    spread = np.linalg.inv(normal)
    *of_sky, deflected = _of_all([spread @ weight for weight in weighted], of_bodies)
    terms = (*of_sky, *(replace(t, factor=spread @ up @ t.factor) for t in of_up))
    plumb = deflected.factor
    ellipsoid = plumb + moved * (place.ellipsoid_stddev - place.plumb_stddev)
    own = total_covariance(t for t in terms if not t.common)
    return AttitudeAtPlace(
        **seen_fields(about, found, place.plumb_axes, own) | {"residual_px": np.array(off_px)},
        residual_arcsec=math.dist(expected, looks[-1].ray) / ARCSEC,
        place=place,
        **attitudes_at(place, found, instrument, terms, (plumb, ellipsoid)),
    )


@dataclass(frozen=True, eq=False)
class _Above:
    """A body over a known place, bent (3,) as it is seen, along east, north and up.

    components (2, 3): across it, sideways and upwards; turn (2, 3): their change by a small rotation.
    terms: errors of them.  g (3, 3): C into east, north, up by the level and the body's azimuth.
    """

    bent: np.ndarray
    components: np.ndarray
    turn: np.ndarray
    terms: tuple[ErrorTerm, ...]
    g: np.ndarray

    @classmethod
    def of(cls, look: _Look, g: np.ndarray, place: Place) -> "_Above":
        """The body over its place; g (3, 3): C into axes whose third is up.  PlaceError below the horizon."""
        shot, a4, moved = look.shot, place.plumb_axes, zenith_moved(place.plumb[0])
        true = a4 @ look.body.from_place(a4[2])
        if true[2] < LOWEST_SINE:
            raise PlaceError(
                f"{shot.stars.place}: at this time and place the {look.body.name.title()} is at an altitude of "
                f"{_altitude_deg(true):.1f} deg, and a heading takes the whole disc above the horizon: the frame shows "
                "something else, or the clock or the place is wrong"
            )
        about = shot.about
        bent, raised = about.atmosphere.raised(true)
        components, local = axes_across(bent[None])[0], g @ look.ray
        g = rotation.about_axis(2, math.atan2(bent[1], bent[0]) - math.atan2(local[1], local[0])) @ g
        turn = np.cross(bent, components)
        terms = (
            *look.terms(components @ g, np.array([0.0, raised])),
            *sky_terms(turn, about.earth, about.clock_stddev_s, about.stamp_stddev_s, a4),
            ErrorTerm("place", turn @ moved @ place.zenith_root, shared=ALWAYS),
            ErrorTerm("deflection", turn @ moved * place.plumb_stddev, shared=ALWAYS),
        )
        return cls(bent, components, turn, terms, g)


def _altitude_deg(direction: np.ndarray) -> float:
    """Altitude of a direction (3,) whose third component points up."""
    return math.degrees(math.asin(min(max(direction[2], -1.0), 1.0)))

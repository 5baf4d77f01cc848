# SPDX-License-Identifier: Apache-2.0
"""The chain from stars and tilt to a solution, which the command line and the node share."""

import math
import time
from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass, field, replace
from functools import cached_property

import numpy as np

from starpos import rotation
from starpos.earth.ellipsoid import curvature_radii_m
from starpos.earth.orientation import ROTATION_RAD_S, EarthState
from starpos.earth.place import Place, Places
from starpos.earth.refraction import Atmosphere
from starpos.errors import (
    FieldError,
    FixError,
    InstrumentError,
    PlaceError,
    StarposError,
    TiltError,
)
from starpos.fix.budget import Circumstances
from starpos.fix.checks import (
    check_above_horizon,
    check_exposure,
    check_risen,
    check_trails,
    check_unmoved,
    set_stars,
    state_at,
    why_unidentified,
)
from starpos.fix.fix import IDEAL, Fix, length_text, pointing_fix, solve_fix
from starpos.fix.heading import AttitudeAtPlace, attitude_at_place
from starpos.fix.solution import TWO_SKIES, UNEXPLAINED, Solution, Status, solution_of, status_of
from starpos.fix.star_fit import MatchedStars, sound_matches
from starpos.frames.exposure import GLOBAL_SHUTTER, UNKNOWN_SHUTTER, Shutter
from starpos.frames.frame import EDGE_PX, Stars
from starpos.frames.tables import Pointing
from starpos.identification import MIN_STARS, Identification, PointingPrior, Sky, field_of, fisheye, identify
from starpos.identification._frame import FrameStars, all_within, ideal_frame, mean_sigma, unit_vectors
from starpos.identification.evidence import finder_of
from starpos.identification.pose import MIN_SIGMA_PX, TEST_STARS
from starpos.identification.prior import AimPrior, Hint
from starpos.identification.search import Look, Priors, identify_near, second_look, through
from starpos.identification.sky import touch
from starpos.identification.triangles import TriangleCatalogue, cached_triangles
from starpos.instrument.camera import EQUIDISTANT, Camera
from starpos.instrument.inclinometer import EITHER_WAY, Tilt
from starpos.instrument.instrument import FISHEYE_AXIS, OWN_LEVEL, UNKNOWN_CLOCK_S, ByGravity, Instrument
from starpos.instrument.tilt_log import NO_TILTS, Tilts
from starpos.progress import Progress, quiet
from starpos.sky import deeper
from starpos.sky.bodies import ERFA, SolarSystem
from starpos.sky.catalogue import Catalogue
from starpos.units import HOUR_S

# A fisheye's lower stars are not used: no model describes refraction near the horizon.
MIN_ALTITUDE_RAD = math.radians(10)

# Sine of the altitude beyond which the stars of a frame determine the sign of up: A3 may be off by degrees.
MIN_UPRIGHT_SINE = math.sin(math.radians(6))


def inside(stars: Stars, camera: Camera) -> np.ndarray | None:
    """Rows of the stars that lie on their frame and in its lens's picture; None if all do, as is usual."""
    if camera.model != EQUIDISTANT and all_within(stars.x, stars.y, stars.width, stars.height, EDGE_PX):
        return None
    on = stars.on_frame & camera.sees(stars.x, stars.y)
    return None if on.all() else np.flatnonzero(on)


def directions_of(camera: Camera, stars: Stars) -> np.ndarray:
    """Unit vectors (N, 3) in C of the stars' pixels."""
    if not camera.is_ideal:
        return camera.directions(stars.x, stars.y)
    return unit_vectors(stars.x, stars.y, camera.fx, camera.fy, camera.cx, camera.cy)


def as_seen(camera: Camera, stars: Stars) -> FrameStars | None:
    """The stars as `identify` takes them, refracted; None unless all lie on the frame of an ideal camera.

    For such a camera this is quicker than by their directions.
    """
    if not camera.is_ideal:
        return None
    field = ideal_frame(stars.x, stars.y, stars.covariance, camera, EDGE_PX, MIN_SIGMA_PX, TEST_STARS)
    return None if field is None else through(field, camera, stars.window)


def high_enough(sines: np.ndarray) -> np.ndarray:
    """Whether stars are above the worst of the air, by the sines (N,) of their altitudes."""
    return sines > math.sin(MIN_ALTITUDE_RAD)


def _aims(stars: Stars, field: FrameStars | fisheye.WideField) -> tuple[AimPrior, ...]:
    """Where a frame's header says that it looks; a fisheye is not pointed."""
    if stars.aim_deg is None or not isinstance(field, FrameStars):
        return ()
    ra, dec = np.radians(stars.aim_deg).tolist()
    return (AimPrior(rotation.unit_vector(ra, dec)),)


HourByLens = Callable[[Stars, Identification, Camera, Catalogue, Atmosphere, Place], bool]

ENOUGH_SOUND = 8
SMALLEST_FIELD_DEG, LARGEST_FIELD_DEG = 0.3, 130.0


@dataclass(frozen=True)
class Solver:
    """Solver for one instrument in its surroundings: `solve` makes a fix, `identify` a pointing alone, by one search.

    Other ways to identify a frame are in `starpos.fix.searching`.

    Attributes
    ----------
    instrument : camera, inclinometer, how both are mounted, and the clock
    catalogue : or the deeper one in its stead, for a field that needs it
    atmosphere : of refraction
    min_stars : fewest identified stars of a fix
    progress : is called with the share of the work that is done
    ephemeris : of the Sun, the Moon and planets
    hour_by_lens : whether the stars of a fisheye's frame at a place show its hour, with a lens fitted to them alone; None
        for stamps that are surely UTC, as of a node's camera

    Examples
    --------
    >>> solver = starpos.Solver(starpos.read_instrument("instrument.yaml"), starpos.load_catalogue())
    >>> stars = starpos.read_frame("night/stars_0000.csv")
    >>> solver.solve(stars, starpos.read_tilt_csv("night/tilt.csv")).fix
    <Fix: +35.70... +51.4...>
    """

    instrument: Instrument
    catalogue: Catalogue
    atmosphere: Atmosphere = field(default_factory=lambda: Atmosphere.measured(None, None))
    _: KW_ONLY
    min_stars: int = 5
    progress: Progress = quiet
    ephemeris: SolarSystem = ERFA
    hour_by_lens: "HourByLens | None" = None

    def prepare(self, width: int, height: int, origin_px: tuple[float, float] | None = None) -> str:
        """Load the tables for frames of this size in px, or build them; raises StarposError.

        Returns what such a field lacks in the catalogue, as `too_thin` says it, '' if nothing.
        """
        camera, catalogue, triangles = self.view(width, height, origin_px)
        # what the first identification would have to wait for
        finder_of(catalogue, triangles)
        touch(triangles)
        return deeper.too_thin(catalogue, camera)

    def identify(
        self, stars: Stars, predicted: Priors = (), part: float = 1.0, look: Look | None = None
    ) -> Solution:
        """Names of the stars and pointing of the camera, near a prediction or anywhere.

        Stars without a time have J2000 places.
        part: of the frame in which its stars lie, as a share of its size: triangles that are looked up are no larger.
        look: shows where the frame of stars that alone are too few has others; a fisheye's stays unidentified then.
        """
        begin = time.perf_counter()
        try:
            camera, catalogue, triangles = self.view(stars.width, stars.height, stars.origin_px)
            if part != 1.0:
                triangles = cached_triangles(catalogue, part * fisheye.field_rad(camera), self.progress)
            sky = Sky.at(catalogue, triangles, stars.mid_unix_s)
            field: FrameStars | fisheye.WideField | None = as_seen(camera, stars)
            if field is None:
                if (rows := inside(stars, camera)) is not None:
                    return self.identify(stars.select(rows), predicted, part, look).among(stars, rows)
                field = field_of(
                    directions_of(camera, stars), mean_sigma(stars.covariance), camera, stars.window
                )
            priors, found = (*predicted, *_aims(stars, field)), None
            if look is None:
                found = identify(field, sky, priors)
            elif isinstance(field, FrameStars):
                found = second_look(field, sky, priors, camera, look)
        except StarposError as e:
            return Solution.refused(stars, e)
        if found is None:
            return _unidentified(stars, camera, sky, begin)
        return solution_of(stars, field, sky, camera, found, begin)

    def solve(
        self,
        stars: Stars,
        tilts: Tilts = NO_TILTS,
        hint: Hint | None = None,
        predicted: Priors = (),
        known: Identification | Hint | None = None,
    ) -> Solution:
        """The fix of one frame; a fault of the frame, the tilt or the time is a status and never an exception.

        tilts: not used for a camera that is its own level.
        predicted, hint: where to look, the latter of an earlier solution; a wrong one costs 0.5 ms and does no harm.
        known: an identification of these stars, or a hint outside of which they are not to be searched.
        """
        try:
            whole = self.instrument.camera_for(stars.width, stars.height, stars.origin_px)
            if (rows := inside(stars, whole)) is not None:
                if isinstance(known, Identification):
                    known = known.but(star=np.searchsorted(rows, known.star))
                return self.solve(stars.select(rows), tilts, hint, predicted, known).among(stars, rows)
            state, tilt = self.levelled(stars, tilts)
            camera, catalogue, triangles = self.view(stars.width, stars.height, stars.origin_px)
            g = self.instrument.level(tilt).camera
            begin = time.perf_counter()
            directions = self.atmosphere.refraction().unbend(directions_of(camera, stars) @ g.T) @ g
            sky = Sky(catalogue, triangles, state.year, tuple(state.velocity))
            field = field_of(directions, mean_sigma(stars.covariance), camera, stars.window)
            if known is None:
                priors = (*predicted, *(hint.priors(state, g[2]) if hint else ()), *_aims(stars, field))
                found = identify(field, sky, priors)
            elif isinstance(known, Hint):
                found = identify_near(field, sky, known.priors(state, g[2]))
            else:
                found = _refracted(known, field, sky, camera)
        except StarposError as e:
            return Solution.refused(stars, e)
        if found is None:
            return replace(_unidentified(stars, camera, sky, begin), tilt=tilt)
        answer, done = solution_of(stars, field, sky, camera, found, begin), time.perf_counter()
        try:
            check_explained(answer)
            fix = self._fix(stars, found, tilt, state)
        except StarposError as e:
            return replace(answer, tilt=tilt, status=status_of(stars, e), message=str(e))
        return replace(
            answer,
            tilt=tilt,
            message="fix",
            fix=fix,
            fix_s=time.perf_counter() - done,
            extrapolated_days=state.orientation.extrapolated_days,
            hint=Hint.at(found, state, camera.fx * found.focal_scale, fix.latitude, fix.longitude),
            named=sky.catalogue.named(found.catalogue[fix.used]),
            star=found.star[fix.used],
        )

    def solve_pointing(self, pointing: Pointing, tilts: Tilts = NO_TILTS) -> Solution:
        """The fix of a frame whose pointing a plate solver found, if it has a roll; a fault is a status."""
        begin = time.perf_counter()
        try:
            if not pointing.has_roll:
                raise FixError(f"{pointing.place}: no roll: one elevation gives no fix, several together do")
            state, tilt = self.levelled(pointing, tilts)
            camera = self.instrument.camera or IDEAL
            fix = pointing_fix(pointing, tilt, self.circumstances(pointing, camera, state))
            check_above_horizon(math.cos(fix.zenith_distance), self.instrument.calibration)
            check_unmoved(fix, self.instrument)
        except StarposError as e:
            return Solution.refused(pointing, e)
        return Solution.of(
            pointing,
            "fix",
            fix=fix,
            tilt=tilt,
            fix_s=time.perf_counter() - begin,
            extrapolated_days=state.orientation.extrapolated_days,
        )

    def levelled(self, frame: Stars | Pointing, tilts: Tilts) -> tuple[EarthState, Tilt]:
        """State of the Earth and the tilt at a frame; StarposError if its time or the tilt cannot be used."""
        state = state_at(frame)
        if self.instrument.vertical is not None:
            tilts = OWN_LEVEL
        own = tilts if isinstance(tilts, ByGravity) else None
        if own is not None:
            tilts = own.of(frame, self.instrument)
        # the width of a uniform distribution with this standard deviation, as rounding causes
        spread_s = math.sqrt(12) * frame.stamp_stddev_s
        tilt = tilts.average(state.utc_unix_s, frame.exposure_s or 0.0, spread_s)
        if tilt.either_way:
            tilt = self._upright(tilt, frame)
        if own is not None:
            own.check_held(frame, tilt)
        self.instrument.calibration.check_age(state.utc_unix_s)
        self.instrument.inclinometer.check_live(tilt)
        self.instrument.inclinometer.check_range(tilt)
        self.instrument.inclinometer.check_axes(tilt)
        return state, tilt

    def _upright(self, tilt: Tilt, frame: Stars | Pointing) -> Tilt:
        """A tilt that may point up or down, by the frame's stars: they are seen, so they are above the horizon."""
        seen = np.array([[0.0, 0.0, 1.0]])
        if isinstance(frame, Stars) and len(frame.x):
            seen = directions_of(self.view(frame.width, frame.height, frame.origin_px)[0], frame)
        sine = float(seen.mean(0) @ self.instrument.calibration.a3.T @ tilt.up)
        if self.instrument.calibration.unknown or abs(sine) < MIN_UPRIGHT_SINE:
            raise TiltError(EITHER_WAY)
        return replace(tilt if sine > 0 else tilt.reversed, either_way=False)

    def _fix(self, stars: Stars, found: Identification, tilt: Tilt, state: EarthState) -> Fix:
        camera, _, _ = self.view(stars.width, stars.height, stars.origin_px)
        up = self.instrument.level(tilt).camera[2]
        use, matched = self._matched(stars, found, up, state)
        if fisheye.is_wide(camera):
            detected = directions_of(camera, stars) @ up
            sines = detected[found.star]
            check_above_horizon(float(sines.mean()), self.instrument.calibration)
            if not self.instrument.calibration.unknown and (low := set_stars(sines, detected)):
                raise FixError(
                    f"by the tilts and A3 {low}: check the signs and the order of the tilts' axes, and A3"
                )
        fix = solve_fix(matched, tilt, self.circumstances(stars, camera.scaled(found.focal_scale), state))
        if not fisheye.is_wide(camera):
            check_above_horizon(math.cos(fix.zenith_distance), self.instrument.calibration)
        check_unmoved(fix, self.instrument)
        return replace(fix, used=np.flatnonzero(use)[fix.used])

    def _matched(
        self, stars: Stars, found: Identification, up: np.ndarray, state: EarthState
    ) -> tuple[np.ndarray, MatchedStars]:
        """Mask (M,) of the identified stars to use, and these; up (3,): rough zenith in C."""
        if len(found.star) < self.min_stars:
            raise FixError(f"only {len(found.star)} stars identified, min_stars is {self.min_stars}: no fix")
        if found.mirrored:
            raise InstrumentError(
                "the frame is mirrored (its rows run bottom-up): flip it, a position needs to know which side is up"
            )
        camera, catalogue, _ = self.view(stars.width, stars.height, stars.origin_px)
        use = sound_matches(stars, found, max(self.min_stars, ENOUGH_SOUND))
        if fisheye.is_wide(camera):
            use &= high_enough(directions_of(camera, stars)[found.star] @ up)
        places = catalogue.directions(found.catalogue[use], state.year, state.observer_au)
        check_exposure(stars, camera, places)
        check_trails(stars, found.star[use], camera, found.attitude, places)
        return use, MatchedStars.of(stars, found, use, camera, catalogue, state.year, places)

    def attitude_at(self, stars: Stars, found: Identification, place: Place) -> AttitudeAtPlace:
        """Heading, pitch and roll at a known place, from a frame's identified stars; needs no tilt.

        Raises StarposError if the stars, the place or the time do not determine them.
        """
        state = state_at(stars)
        camera, catalogue, triangles = self.view(stars.width, stars.height, stars.origin_px)
        up = found.attitude @ state.gcrs_to_itrs.T @ place.plumb_axes[2]
        sky = Sky(catalogue, triangles, state.year, tuple(state.velocity))
        check_risen(stars, found, camera, sky, up)
        use, matched = self._matched(stars, found, up, state)
        about = self.circumstances(stars, camera.scaled(found.focal_scale), state)
        uncalibrated = fisheye.is_wide(camera) and not any(camera.distortion)
        if uncalibrated:
            about = replace(about, axis_stddev=max(about.axis_stddev, FISHEYE_AXIS))
        attitude = attitude_at_place(matched, place, about)
        shown = attitude.hour_shown or self._hour_at_horizon(stars, found, state, up)
        if not shown and self.hour_by_lens is not None:
            air = self.atmosphere
            shown = uncalibrated and self.hour_by_lens(stars, found, about.camera, catalogue, air, place)
            if not shown and about.clock_stddev_s == UNKNOWN_CLOCK_S:
                attitude = attitude_at_place(matched, place, replace(about, clock_stddev_s=HOUR_S))
        return replace(attitude, used=np.flatnonzero(use)[attitude.used], hour_shown=shown)

    def _hour_at_horizon(
        self, stars: Stars, found: Identification, state: EarthState, up: np.ndarray
    ) -> bool:
        """Whether an hour more or less would put stars under the horizon; up (3,): the zenith in C."""
        camera, _, _ = self.view(stars.width, stars.height, stars.origin_px)
        pole, every = found.attitude @ state.gcrs_to_itrs[2], directions_of(camera, stars)
        turned = (rotation.from_vector(sign * ROTATION_RAD_S * HOUR_S * pole) @ up for sign in (1, -1))
        return all(set_stars((every @ zenith)[found.star], every @ zenith) for zenith in turned)

    def circumstances(self, frame: Stars | Pointing, camera: Camera, earth: EarthState) -> Circumstances:
        """How a frame was taken, by a camera in its pixels, at a state of the Earth."""
        return Circumstances(
            camera=camera,
            instrument=self.instrument,
            atmosphere=self.atmosphere,
            earth=earth,
            clock_stddev_s=self.clock_stddev_s(frame),
            stamp_stddev_s=frame.stamp_stddev_s,
            # a pointing is of one time
            shutter=self.shutter(frame) if isinstance(frame, Stars) else GLOBAL_SHUTTER,
            axis_stddev=math.hypot(self.instrument.axis_stddev_rad, self.instrument.lens_stddev_rad),
        )

    def clock_stddev_s(self, stars: Stars | Pointing) -> float:
        """Standard deviation of the clock that stamped the stars: its host's own, but at least the instrument's."""
        return max(self.instrument.clock_stddev_s, stars.clock_stddev_s)

    def shutter(self, stars: Stars) -> Shutter:
        """The shutter as the instrument states it, else as the stars' source does."""
        return self.instrument.shutter or stars.shutter or UNKNOWN_SHUTTER

    @cached_property
    def _views(self) -> dict[tuple, tuple[Camera, Catalogue, TriangleCatalogue]]:
        """The latest results of `view`, by size and origin."""
        return {}

    def view(
        self, width: int, height: int, origin_px: tuple[float, float] | None = None
    ) -> tuple[Camera, Catalogue, TriangleCatalogue]:
        """Camera for frames of this size in px, catalogue for its field and its triangles; raises StarposError.

        origin_px: column and row of the camera's whole frame at which they begin, as their Exposure has it.
        """
        key = width, height, origin_px
        if key in self._views:
            return self._views[key]
        camera = self.instrument.camera_for(width, height, origin_px)
        field_deg = math.degrees(2 * camera.half_diagonal_rad)
        if field_deg < SMALLEST_FIELD_DEG or (field_deg > LARGEST_FIELD_DEG and not fisheye.is_wide(camera)):
            raise FieldError(
                f"focal length {camera.fx:.0f} px makes a field of {field_deg:.2f} deg across, this program works "
                f"from {SMALLEST_FIELD_DEG:g} to {LARGEST_FIELD_DEG:g} deg: check focal length and pixel size, and "
                "whether the lens is a fisheye (equidistant)"
            )
        catalogue = deeper.for_field(self.catalogue, camera)
        triangles = cached_triangles(catalogue, fisheye.field_rad(camera), self.progress)
        # one size is usual
        self._views.clear()
        self._views[key] = camera, catalogue, triangles
        return self._views[key]


def _refracted(
    known: Identification, field: FrameStars | fisheye.WideField, sky: Sky, camera: Camera
) -> Identification:
    """A known identification where refraction is removed from the field; as it was if it cannot be confirmed."""
    if known.mirrored:
        return known
    prior = PointingPrior(known.attitude, camera.fx * known.focal_scale)
    return identify_near(field, sky, (prior,)) or known


def _unidentified(stars: Stars, camera: Camera, sky: Sky, begin_s: float) -> Solution:
    status = Status.TOO_FEW_STARS if len(stars) < MIN_STARS else Status.NOT_IDENTIFIED
    failed = Solution.failed(stars, status, why_unidentified(stars, camera, sky.catalogue))
    return replace(failed, identify_s=time.perf_counter() - begin_s)


def check_explained(answer: Solution) -> None:
    """Raise FixError if the identification is suspicious."""
    place, seen = answer.source or "the frame", answer.explained
    if TWO_SKIES in answer.warnings:
        raise FixError(
            f"{place}: two skies in one frame, its bright stars belong to two pointings: keep the camera still "
            "while it exposes, and expose once"
        )
    if UNEXPLAINED in answer.warnings and seen is not None:
        raise FixError(
            f"{place}: only {seen.explained} of its {seen.bright} brightest detections are stars of the sky found, and "
            f"only {seen.seen} of the {seen.due} brightest stars there are detected: look at the frame"
        )


UNSHOWN_HOUR = (
    "nothing in the frame shows that its hour is right, and a wrong one turns the heading by degrees: its error "
    "holds for UTC within the clock's stated error, and where none is stated (--clock-stddev) it contains an "
    "hour. Stars down to 10 deg of altitude show the hour"
)

# a correct place lies further from the stars' own once in 1e6 frames
PLACE_SIGMAS = 5.3


def placed(solver: Solver, stars: Stars, answer: Solution, places: Places) -> Solution:
    """The answer to a frame with heading, pitch and roll at its known place, if its stars are identified.

    Where there is a fix, a place that contradicts it gives no heading, and the remark says so. Without a fix the status
    says why there is no heading.
    """
    if answer.found is None or stars.mid_unix_s is None:
        return answer
    try:
        check_explained(answer)
        place = places.at(stars.mid_unix_s)
        if answer.fix is not None:
            check_agrees(answer.fix, place)
        attitude = solver.attitude_at(stars, answer.found, place)
        if not attitude.hour_shown:
            answer = answer.with_remark(UNSHOWN_HOUR)
        alone = answer.ok and answer.fix is None
        return replace(answer, at_place=attitude, message=attitude.text if alone else answer.message)
    except StarposError as e:
        if answer.fix is not None:
            return replace(answer, remark=f"{stars.place}: no heading at the known place: {e}")
        return replace(answer, status=status_of(stars, e), message=str(e))


def check_agrees(fix: Fix, place: Place) -> None:
    """Raise PlaceError if the stars' own place is further from a known one than their errors allow."""
    latitude, longitude = place.plumb
    prime, meridian = radii = np.array(curvature_radii_m(latitude))
    east = math.remainder(fix.longitude - longitude, 2 * math.pi) * prime * math.cos(latitude)
    off = np.array([east, (fix.latitude - latitude) * meridian])
    claim = fix.covariance[:2, :2] + place.covariance + np.diag((radii * place.plumb_stddev) ** 2)
    sigmas = math.sqrt(off @ np.linalg.solve(claim, off))
    if sigmas > PLACE_SIGMAS:
        raise PlaceError(
            f"stars and tilt give a position {length_text(float(np.linalg.norm(off)))} from the given one, "
            f"{sigmas:.0f} times their stated errors: check latitude and longitude, their order and signs, "
            f"the tilts, A3 and the clock"
        )


# Ratio of successive tries, each of which tolerates an error of 3 %; number of tries on either side.
FOCAL_STEP, FOCAL_TRIES = 1.055, 6


def focal_that_fits(solver: Solver, stars: Stars, until_s: float = math.inf) -> float | None:
    """The focal length in px at which a frame is identified, from 0.7 to 1.4 times the solver's; None without one.

    With the solver's own it is not identified, which is not tried again. No try is begun after until_s (time.monotonic).
    Triangles are found by their angles, which hardly depend on the focal length, so the given field's triangles serve.
    """
    on = stars.select(stars.on_frame.nonzero()[0])
    if len(on) < MIN_STARS:
        return None
    try:
        given, catalogue, triangles = solver.view(on.width, on.height, on.origin_px)
        sky = Sky.at(catalogue, triangles, on.mid_unix_s)
        for k in sorted({*range(-FOCAL_TRIES, FOCAL_TRIES + 1)} - {0}, key=abs):
            if time.monotonic() >= until_s:
                break
            camera = given.scaled(FOCAL_STEP**k)
            seen = on.select(camera.sees(on.x, on.y).nonzero()[0])
            field = field_of(camera.directions(seen.x, seen.y), seen.sigma, camera)
            found = identify(field, sky)
            if found is not None:
                return camera.fx * found.focal_scale
    except StarposError:
        # the frame's own sentence says it
        return None
    return None

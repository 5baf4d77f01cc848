# SPDX-License-Identifier: Apache-2.0
"""Calibrates a camera with the sky: identifies frames, fits the camera and their attitudes, and judges the fit."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from starpos.calibration.camera_adjustment import (
    LEAN_RAD,
    LEANS,
    STEP_RAD,
    CameraAdjustment,
    CameraEstimate,
    CameraSighting,
    camera_values,
    parameters,
    settled_camera,
    unbent,
    unknowns,
    with_values,
)
from starpos.calibration.misalignment import NOTHING_KNOWN, Known
from starpos.earth.orientation import earth_state
from starpos.earth.place import Place
from starpos.earth.refraction import Atmosphere
from starpos.errors import CalibrationError, InstrumentError
from starpos.fix.checks import check_risen, state_at
from starpos.fix.heading import checked_zenith, confirms_hour, feigned
from starpos.fix.solver import ENOUGH_SOUND, high_enough
from starpos.fix.star_fit import MatchedStars, sound_matches
from starpos.frames.frame import Stars
from starpos.frozen import at_once
from starpos.identification import Identification, PointingPrior, Sky, field_of, fisheye, identify, triangles
from starpos.identification.triangles import TriangleCatalogue
from starpos.instrument.camera import DECENTRED, EQUIDISTANT, Camera, pixels_over
from starpos.progress import Progress, quiet
from starpos.sky import deeper
from starpos.sky.catalogue import Catalogue

# the sky determines a parameter if its sigma is below this share of the prior's
DETERMINED = 0.5
# sigma; a parameter further off than this is not of the given camera
BEYOND_PRIOR = 5.0
# stars for each free parameter; with fewer, one wrong match in a corner can look like a lens
STARS_EACH = 3
MAX_SCATTER_PX = 1.5
# number of points per side of the frame at which a camera is checked and its error computed
BORDER = 25


@at_once
@dataclass(frozen=True, kw_only=True)
class Intrinsics:
    """A camera that was fitted to stars.

    covariance (P, P): of the camera's `parameters`, with the scatter beyond the stars' own errors; prior_sigma (P,): of
    the priors.
    attitudes (F, 3, 3): of the frames.
    xy (N, 2) in px: the stars that were kept, frame by frame; frame (N,): the frame of each.
    residual (N, 2) in px: measured minus predicted; before (N, 2): with the given camera, of which only the focal length
    and the attitudes were fitted.
    scatter_px: sigma per axis beyond the stars' own errors.  rejected: number of stars left out.
    """

    camera: Camera
    covariance: np.ndarray
    prior_sigma: np.ndarray
    attitudes: np.ndarray
    xy: np.ndarray
    frame: np.ndarray
    residual: np.ndarray
    before: np.ndarray
    scatter_px: float
    rejected: int

    @property
    def values(self) -> np.ndarray:
        """Values (P,) of the camera's parameters."""
        return camera_values(self.camera)

    @property
    def sigma(self) -> np.ndarray:
        """Standard deviations (P,) of the camera's parameters."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def determined(self) -> np.ndarray:
        """Mask (P,) of those parameters that the sky determines; the others are held by their priors."""
        return self.sigma < DETERMINED * self.prior_sigma

    @property
    def rms_px(self) -> float:
        """Root mean square of the residuals per axis."""
        return rms(self.residual)

    def sigma_px(self, xy: np.ndarray) -> np.ndarray:
        """Sigma per axis (N,) in px of the camera's predictions at pixels xy (N, 2), after a fit of attitude and scale.

        Every use of the camera fits these two, so their part of the covariance does not matter.
        """
        grid = self._grid
        both = np.concatenate([grid, xy])
        j, free = (_derivatives(self.camera, both, k) for k in (parameters(self.camera), ()))
        n = 2 * len(grid)
        fitted = np.linalg.lstsq(free[:n], j[:n], rcond=None)[0]
        left = (j - free @ fitted)[n:]
        return np.sqrt(np.einsum("ni,ij,nj->n", left, self.covariance, left).reshape(-1, 2).mean(1))

    @property
    def worst_sigma_px(self) -> float:
        """The largest of `sigma_px` over the frame; of a fisheye where it has shown stars."""
        return float(self.sigma_px(self._grid).max())

    @property
    def _grid(self) -> np.ndarray:
        """Pixels (G, 2) all over the frame; of a fisheye where it has shown stars."""
        grid = pixels_over(self.camera.width, self.camera.height, BORDER)
        middle = [self.camera.cx, self.camera.cy]
        if self.camera.model != EQUIDISTANT:
            return grid
        return grid[np.hypot(*(grid - middle).T) <= np.hypot(*(self.xy - middle).T).max()]


def rms(residual: np.ndarray) -> float:
    """Root mean square per axis of residuals (N, 2)."""
    return float(np.sqrt(np.mean(residual * residual)))


def fit_camera(
    sightings: Sequence[CameraSighting], given: Camera, atmosphere: Atmosphere, free: Sequence[str] = ()
) -> Intrinsics:
    """Fit a camera near the `given` one to all sightings; parameters that are not in `free` keep their values.

    Without `free` all are fitted. Raises CalibrationError if the stars are too few or do not agree.  `check_sound` says
    whether the fit is good.
    """
    free = free or parameters(given)
    count, fewest = sum(len(s.stars.xy) for s in sightings), fewest_stars(free)
    if count < fewest:
        raise CalibrationError(
            f"{count} identified stars are too few for a camera: give frames with {fewest} at least"
        )
    problem = CameraAdjustment.of(sightings, given, atmosphere, free)
    state, covariance, keep, jitter2 = settled_camera(problem)
    to_named = problem.named_per_unit()
    held = replace(problem, sigma=problem.sigma * (np.array(unknowns(given)) == "scale"))
    before, _ = held.refined(
        CameraEstimate(np.zeros(len(problem.sigma)), problem.start), problem.stated + np.eye(2), keep
    )
    return Intrinsics(
        camera=problem.camera(state.q),
        covariance=to_named @ covariance @ to_named.T,
        prior_sigma=np.sqrt(np.square(to_named).sum(1)),
        attitudes=state.attitudes,
        xy=problem.xy[keep],
        frame=problem.frame[keep],
        residual=problem.residual(state)[keep],
        before=held.residual(before)[keep],
        scatter_px=float(np.sqrt(jitter2)),
        rejected=int((~keep).sum()),
    )


def fewest_stars(free: Sequence[str]) -> int:
    """Number of stars that a camera with these free parameters needs; an attitude counts as one parameter."""
    return STARS_EACH * (len(free) + 1)


def check_sound(fitted: Intrinsics, given: Camera) -> None:
    """Raise CalibrationError if the fit is not good enough to work with."""
    if (np.abs(fitted.values - camera_values(given)) > BEYOND_PRIOR * fitted.prior_sigma).any():
        raise CalibrationError(
            "the stars fit a camera too different from the given one: check focal length and pixel size, "
            "and that the frames "
            "are of one camera"
        )
    if fitted.scatter_px > MAX_SCATTER_PX:
        raise CalibrationError(
            f"the identified stars lie {fitted.scatter_px:.1f} px off the best camera, {MAX_SCATTER_PX:g} at most are "
            "allowed: check that the frames are sharp and of one camera and focus"
        )
    check_invertible(fitted.camera)


def check_invertible(camera: Camera) -> None:
    """Raise CalibrationError if the distortion folds inside the frame."""
    try:
        camera.directions(*pixels_over(camera.width, camera.height, BORDER).T)
    except InstrumentError:
        raise CalibrationError(
            "the distortion fitted to these stars folds inside the frame: give more frames, with stars in "
            "the corners"
        ) from None


def _derivatives(camera: Camera, xy: np.ndarray, names: Sequence[str]) -> np.ndarray:
    """Derivatives (2 N, P) of pixels by the parameters named; without names, by attitude and scale (2 N, 4)."""
    v = camera.directions(*xy.T)
    here = camera.project(v)
    if not names:
        turned = [camera.project(v + np.cross(t, v)) - here for t in np.eye(3) * STEP_RAD]
        turned.append(camera.scaled(1 + STEP_RAD).project(v) - here)
        return np.stack(turned, -1).reshape(-1, 4) / STEP_RAD
    moved = [
        with_values(camera, camera_values(camera) + step).project(v) - here for step in np.eye(len(names))
    ]
    return np.stack(moved, -1).reshape(-1, len(names))


# the first rounds have coarse matches and fit few terms: with more, wrong matches in the corners would confirm themselves
FIRST_FREE = (("fx", "fy", "k1"), ("fx", "fy", "cx", "cy", "k1"), ("fx", "fy", "cx", "cy", "k1", "k2"))
# below FEW times the minimum number of stars nearly all must fit, because a wrong lens leaves some over
FEW, NEARLY_ALL = 2, 0.9
# most rounds in which all terms are fitted
ROUNDS = 5
# a round that finds no more than this share of new stars is the last
SETTLED_SHARE = 0.002


# BIC by which two more terms must be better
SUPPORTED = 10.0


@dataclass(frozen=True)
class FromSky:
    """A camera from frames; used: indices of the frames that were identified, in the order of the fit.

    lean_rad, lean_sigma_rad: how far the zenith by refraction is from the one by time and place, and its error along the
    worse axis; NaN where no place is known.
    """

    fit: Intrinsics
    used: tuple[int, ...]
    lean_rad: float = np.nan
    lean_sigma_rad: float = np.nan


def calibrate_camera(
    frames: Sequence[Stars],
    levels: Sequence[np.ndarray | None],
    given: Camera,
    catalogue: Catalogue,
    atmosphere: Atmosphere,
    progress: Progress = quiet,
    known: Known = NOTHING_KNOWN,
    site: Place | None = None,
) -> FromSky:
    """One camera from frames of any attitudes.

    Parameters
    ----------
    frames : stars of frames of one size; those that are not identified are left out
    levels : for each frame the rotation (3, 3) of C into the local level L, None if unknown
    given : a camera that is right to 3 % of the focal length and a few px of distortion; a fisheye to 5 px within 30 deg
        of its axis
    catalogue : or the deeper one in its stead, for a field that needs it
    atmosphere : of refraction
    progress : is called with the share of the work that is done
    known : the stars of frames, by the frames' numbers, that only a longer search identifies
    site : where the camera is: the stars then show its level, and `levels` are not needed

    A fisheye has DECENTRED terms if the stars support them.

    Returns
    -------
    FromSky
        `fit.camera`, and the indices of the frames that were used

    Raises
    ------
    CalibrationError
        no camera can be found
    PlaceError
        stars would be under the horizon of the site, or refraction shows another zenith
    InstrumentError
        a frame is mirrored
    TimeError
        a time is impossible

    Examples
    --------
    >>> stars = [starpos.read_frame(path) for path in sorted(Path("turn").glob("stars_*.csv"))]
    >>> given = starpos.Camera.from_focal(1000, 700, 4600.0)
    >>> air, catalogue = starpos.Atmosphere(), starpos.load_catalogue()
    >>> found = starpos.calibrate_camera(stars, [None] * len(stars), given, catalogue, air)
    >>> abs(found.fit.camera.fx - 4635.9) < 5
    True
    """
    for stars in frames:
        if (stars.width, stars.height) != (given.width, given.height):
            raise CalibrationError(
                f"{stars.source}: the frame is {stars.width} x {stars.height} px but the first or the instrument has "
                f"{given.width} x {given.height}: give frames of one size"
            )
    if fisheye.is_wide(given) and site is None and any(level is None for level in levels):
        raise CalibrationError(
            "without a level refraction cannot be separated from a fisheye's distortion: give the place with --site, or "
            "the --tilt of its frames"
        )
    catalogue = deeper.for_field(catalogue, given)
    table = triangles.cached_triangles(catalogue, fisheye.field_rad(given), progress)
    every = parameters(given)
    skies = [
        _Frame.of(stars, level, catalogue, table, site) for stars, level in zip(frames, levels, strict=True)
    ]
    camera, before = given, 0
    for n, found in known.items():
        skies[n].check_risen(frames[n], found, given)
    attitudes = {n: found.attitude for n, found in known.items() if not found.mirrored}
    rounds = len(FIRST_FREE) + ROUNDS
    for k in range(rounds):
        free = FIRST_FREE[k] if k < len(FIRST_FREE) else every
        sightings = {}
        for n, frame in enumerate(skies):
            if sighting := frame.sighting(camera, atmosphere, attitudes.get(n)):
                sightings[n] = sighting
            progress("camera", (k + (n + 1) / len(skies)) / rounds)
        if not sightings:
            raise CalibrationError(
                f"no part of the sky matches any of the {len(frames)} frames: check the focal length "
                f"({given.fx:.0f} px given, "
                "3 % is allowed), clouds and exposure"
            )
        fit = fit_camera(list(sightings.values()), given, atmosphere, free)
        check_invertible(fit.camera)
        camera = fit.camera
        attitudes = {n: skies[n].of_sky(a) for n, a in zip(sightings, fit.attitudes, strict=True)}
        count = sum(len(s.stars.xy) for s in sightings.values())
        if k >= len(FIRST_FREE) and abs(count - before) <= SETTLED_SHARE * count:
            if (more := _decentred(list(sightings.values()), given, atmosphere, fit)) is None:
                break
            fit, given = more, replace(given, distortion=(*given.distortion, *[0.0] * len(DECENTRED)))
            camera, every = fit.camera, parameters(given)
        before = count
    there = sum(len(skies[n].stars) for n in sightings)
    few = FEW * fewest_stars(every)
    if count < few and len(fit.xy) < NEARLY_ALL * there:
        raise CalibrationError(
            f"{len(fit.xy)} of {there} stars fit one camera, too few to be sure of it: give frames with {few} or more"
        )
    check_sound(fit, given)
    lean = _lean(list(sightings.values()), fit, atmosphere) if site is not None else ()
    progress("camera", 1.0)
    return FromSky(fit, tuple(sightings), *lean)


def _decentred(
    sightings: Sequence[CameraSighting], given: Camera, atmosphere: Atmosphere, fit: Intrinsics
) -> Intrinsics | None:
    """The fit of a fisheye with DECENTRED terms, if the stars support them better than `fit`; else None."""
    if not fisheye.is_wide(given) or given.coefficients[-2:] == DECENTRED:
        return None
    more = replace(given, distortion=(*given.distortion, *[0.0] * len(DECENTRED)))
    other = fit_camera(sightings, more, atmosphere)
    # of the stars that both fits keep
    names = [set(zip(f.frame.tolist(), *f.xy.T.tolist(), strict=True)) for f in (fit, other)]
    squares = [
        np.sum(
            f.residual[[name in shared for name in zip(f.frame.tolist(), *f.xy.T.tolist(), strict=True)]] ** 2
        )
        for f, shared in ((fit, names[1]), (other, names[0]))
    ]
    n = 2 * len(names[0] & names[1])
    gain = n * np.log(squares[0] / squares[1]) - len(DECENTRED) * np.log(n)
    return other if gain > SUPPORTED else None


def _lean(
    sightings: Sequence[CameraSighting], fit: Intrinsics, atmosphere: Atmosphere
) -> tuple[float, float]:
    """How far (rad) the zenith by refraction is off, and its error; PlaceError if it contradicts time and place."""
    problem = CameraAdjustment.of(sightings, fit.camera, atmosphere, parameters(fit.camera))
    if not problem.upright or atmosphere.pressure_pa == 0:
        return np.nan, np.nan
    state, _, keep, jitter2 = settled_camera(problem)
    leaning, errors = problem.leaning(state), problem.stated + np.eye(2) * jitter2
    start = CameraEstimate(np.zeros(len(leaning.sigma)), leaning.start)
    # one step: with many terms of a lens free, a lean has other minima far away
    q, _, covariance = leaning.step(start, errors, keep)
    last = slice(-len(LEANS), None)
    widened = covariance[last, last] * feigned(jitter2, problem.stated)
    return checked_zenith(LEAN_RAD * q[last], LEAN_RAD**2 * widened)


# stars lower than this do not show where a platepar's pixels look
SEEN_ABOVE_RAD = np.radians(10)


def seen_by(
    camera: Camera, attitude: np.ndarray, site: Place, atmosphere: Atmosphere, utc_unix_s: float
) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (N, 2) all over a fixed camera's frame, and the ICRS directions (N, 3) that they show.

    attitude (3, 3): east, north, up at the site into C.
    """
    xy = pixels_over(camera.width, camera.height, BORDER)
    xy = xy[camera.sees(*xy.T)]
    local = camera.directions(*xy.T) @ attitude
    high = local[:, 2] > np.sin(SEEN_ABOVE_RAD)
    itrs = atmosphere.refraction().unbend(local[high]) @ site.plumb_axes
    return xy[high], earth_state(utc_unix_s).of_itrs(itrs)


def hour_by_lens(
    stars: Stars,
    found: Identification,
    given: Camera,
    catalogue: Catalogue,
    atmosphere: Atmosphere,
    place: Place,
) -> bool:
    """Whether a fisheye's frame alone shows its hour, whatever its lens; PlaceError if it shows another one."""
    try:
        fit = calibrate_camera([stars], [None], given, catalogue, atmosphere, known={0: found}, site=place)
    except (CalibrationError, InstrumentError):
        return False
    return confirms_hour(fit.lean_rad, fit.lean_sigma_rad)


# Rounds in which one frame's stars are identified again with the lens found so far, and the significance of a k1 to use.
LENS_ROUNDS, LENS_SIGMA = 3, 3.0


def lens_of_frame(
    stars: Stars, found: Identification, given: Camera, catalogue: Catalogue, atmosphere: Atmosphere
) -> tuple[Camera, float]:
    """A camera with what one frame's stars show of its lens; the given one if they do not show a k1.

    found: of these stars.  given: an ideal camera of about the right focal length.

    Returns the camera, and the error of directions in C (rad, 1 sigma about each axis across the optical axis) by what
    the stars leave open of the lens. The place of the optical axis is no part of it: its error is one of A3's.
    """
    catalogue = deeper.for_field(catalogue, given)
    table = triangles.cached_triangles(catalogue, fisheye.field_rad(given))
    frame = _Frame.of(stars, None, catalogue, table, None)
    k1, off_axis = parameters(given).index("k1"), [p for p in parameters(given) if p not in ("cx", "cy")]
    camera, attitude, scatter2 = given, found.attitude, found.mean_square_px2
    try:
        for free in (*[FIRST_FREE[0]] * LENS_ROUNDS, off_axis):
            sighting = frame.sighting(camera, atmosphere, attitude)
            if sighting is None:
                break
            fit = fit_camera([sighting], given, atmosphere, free)
            check_invertible(fit.camera)
            if not (fit.determined[k1] and abs(fit.values[k1]) > LENS_SIGMA * fit.sigma[k1]):
                camera, attitude = given, found.attitude
                break
            camera, attitude, scatter2 = fit.camera, fit.attitudes[0], fit.scatter_px**2
    # what was found with fewer terms holds
    except (CalibrationError, InstrumentError):
        pass
    sighting = frame.sighting(camera, atmosphere, attitude)
    return camera, 0.0 if sighting is None else _turned_by_lens(
        sighting, camera, atmosphere, scatter2, off_axis
    )


def _turned_by_lens(
    sighting: CameraSighting, camera: Camera, atmosphere: Atmosphere, scatter_px2: float, free: Sequence[str]
) -> float:
    """How far (rad, 1 sigma) the terms of a lens that a frame's stars do not show may turn its directions."""
    problem = CameraAdjustment.of([sighting], camera, atmosphere, free)
    start = CameraEstimate(np.zeros(len(problem.sigma)), problem.start)
    errors = problem.stated + np.eye(2) * scatter_px2
    step, _, covariance = problem.step(start, errors, np.ones(len(errors), bool))
    bent, turned = (_derivatives(camera, problem.xy, of) for of in (parameters(camera), ()))
    turns = np.linalg.lstsq(turned, bent, rcond=None)[0][:2] @ problem.named_per_unit()
    return float(np.sqrt(np.trace(turns @ (covariance + np.outer(step, step)) @ turns.T) / 2))


@at_once
@dataclass(frozen=True)
class _Frame:
    """The stars of a frame, and the sky of its date.

    to_local (3, 3): the sky's directions into L at the known place; None without one.
    """

    stars: Stars
    level: np.ndarray | None
    sky: Sky
    to_local: np.ndarray | None

    @classmethod
    def of(
        cls,
        stars: Stars,
        level: np.ndarray | None,
        catalogue: Catalogue,
        table: TriangleCatalogue,
        site: Place | None,
    ) -> "_Frame":
        local = None
        if site is not None and level is None:
            local = site.plumb_axes @ state_at(stars).gcrs_to_itrs
        return cls(stars.select(stars.on_frame), level, Sky.at(catalogue, table, stars.mid_unix_s), local)

    def of_sky(self, attitude: np.ndarray) -> np.ndarray:
        """The attitude of a fit, as one of the sky's directions into C."""
        return attitude if self.to_local is None else attitude @ self.to_local

    def check_risen(self, stars: Stars, found: Identification, camera: Camera) -> None:
        """Raise PlaceError if identified stars would be under the horizon of the known place."""
        if self.to_local is not None:
            check_risen(stars, found, camera, self.sky, found.attitude @ self.to_local[2])

    def _level(self, attitude: np.ndarray | None) -> np.ndarray | None:
        """C into L, by the tilts, or by the place and an attitude of the sky."""
        if self.to_local is None or attitude is None:
            return self.level
        return self.to_local @ attitude.T

    def sighting(
        self, camera: Camera, atmosphere: Atmosphere, attitude: np.ndarray | None
    ) -> CameraSighting | None:
        """The stars that are identified with this camera, first near a known attitude (3, 3); None if none are.

        Raises InstrumentError for a mirrored frame, PlaceError where its stars would be under the horizon.
        """
        stars = self.stars.select(camera.sees(self.stars.x, self.stars.y))
        seen = unbent(camera.directions(stars.x, stars.y), self._level(attitude), atmosphere)
        priors = () if attitude is None else (PointingPrior(attitude, camera.fx),)
        found = identify(field_of(seen, stars.sigma, camera), self.sky, priors)
        if found is None:
            return None
        if found.mirrored:
            raise InstrumentError(
                f"{self.stars.source}: the frame is mirrored (its rows run bottom-up): flip it"
            )
        # others were checked when they became known
        if attitude is None:
            self.check_risen(stars, found, camera)
        use = sound_matches(stars, found, ENOUGH_SOUND)
        level = self._level(found.attitude)
        if level is not None and fisheye.is_wide(camera):
            use &= high_enough(seen[found.star] @ level[2])
        sky, places, attitude = self.sky, self.sky.directions(found.catalogue[use]), found.attitude
        if self.to_local is not None:
            places, attitude = places @ self.to_local.T, attitude @ self.to_local.T
        return CameraSighting(
            stars=MatchedStars.of(stars, found, use, camera, sky.catalogue, sky.year, places),
            attitude=attitude,
            level=self.level,
            timed=self.stars.mid_unix_s is not None,
            upright=self.to_local is not None,
        )

# SPDX-License-Identifier: Apache-2.0
"""A3 from frames: at a known place, at several headings of an unknown one, or of a fixed camera that is its own level."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np

from starpos import rotation
from starpos.averaging.poses import poses_of
from starpos.averaging.scatter import Scatter
from starpos.calibration.plumb_line import MIN_POSES, PlumbLine, Readings, hang, level, settled, typical
from starpos.earth.ellipsoid import enu_axes
from starpos.earth.place import Place
from starpos.errors import FixError
from starpos.fix.budget import level_rows, local_north
from starpos.fix.fix import Fix
from starpos.fix.solution import Solution, Status
from starpos.fix.solver import Solver
from starpos.fix.terms import ALWAYS, ErrorTerm
from starpos.frames.frame import Stars
from starpos.frames.tables import Pointing
from starpos.identification import Identification
from starpos.identification.prior import Hint
from starpos.instrument.inclinometer import InclinometerErrors, angles_at, stated_variances
from starpos.instrument.instrument import (
    OWN_LEVEL,
    SAG_ARCSEC_PER_SQRT_HOUR,
    UNKNOWN_ARCSEC,
    VALID_DAYS,
    Calibration,
    CameraVertical,
    Instrument,
    level_errors,
)
from starpos.instrument.tilt_log import Tilts, mean_known
from starpos.progress import Progress, quiet
from starpos.units import ARCSEC

SOLVING_ROUNDS = 4
SETTLED_RAD = 0.02 * ARCSEC
# factor on the sigma of A3's turn from the leans that the fixes use, because both come from the same tilts
TURN_SIGMA = 3.0
# frames further off are left out, up to this share of all, and so often are those left judged again
OUTLIER_SIGMA, MAX_OUTLIERS, JUDGED = 6.0, 1 / 3, 5
# number of poses of which two thirds leave the fit, with its five parameters, free enough to judge the others
MANY_POSES = 10
# Number of frames from which one alone is shown to be wrong, and by how many times what the others differ: errors of
# poses look so once in 1000 nights of five frames
FEW_FRAMES, FAR_WRONG = 5, 20.0
# frames that scatter more than any inclinometer or mount were moved, or are of several places
MAX_POSE_RAD = np.radians(0.5)
# minimum noise over a frame's own error that is worth stating
NOISIER = 1.0
# minimum significance of a coefficient of the response, in sigma
SHOWN_SIGMA = 3.0
# maximum chi-square per degree of freedom of frames too few to estimate their scatter
MAX_SCATTER = 16.0
# share by which a coefficient of the response must be known better, or worse, than stated to be worth keeping
WORTH = 0.05

# A3 and the zenith from readings and A3 as it is
FindPlumbLine = Callable[[Readings, np.ndarray], PlumbLine]
# the same from some of the readings
FitOfRows = Callable[[np.ndarray], PlumbLine]
# what is identified already, by the numbers of the frames
Known = Mapping[int, Identification]
NOTHING_KNOWN: Known = MappingProxyType({})


@dataclass(frozen=True)
class Calibrated:
    """An instrument with its new A3, and each frame solved with it.

    plumb_stddev_arcsec: sigma of the plumb line in the camera, on the worse of two axes.
    beyond: a sentence on how much the frames scatter beyond the stated errors, and what to state; '' if they do not.
    The budgets of the fixes take A3 as unknown, because the calibration was made from the same frames; of a level inside
    the camera, as known as such a level is.
    """

    instrument: Instrument
    plumb_stddev_arcsec: float
    solutions: tuple[Solution, ...]
    beyond: str = ""

    @property
    def fixes(self) -> list[Fix]:
        """The fixes of the frames that have one."""
        return [s.fix for s in self.solutions if s.fix]


def calibrate_at(
    solver: Solver,
    frames: Sequence[Stars | Pointing],
    tilts: Tilts,
    site: Place,
    turn_stddev_deg: float = 180.0,
    progress: Progress = quiet,
    known: Known = NOTHING_KNOWN,
) -> Calibrated:
    """A3 from one or more frames at a known place; the solver's A3 need not be near.

    Parameters
    ----------
    solver : of the instrument
    frames : lists of stars, or pointings of another program
    tilts : of their times
    site : the known place
    turn_stddev_deg : sigma of the turn of the solver's A3 about the plumb line. One lean of the instrument does not
        determine that turn, and only a fix at another lean needs it; the covariance shows it.
    progress : is called with the share of the work that is done
    known : the stars of frames, by the frames' numbers, that only a longer search identifies than the solver's

    Returns
    -------
    Calibrated
        `instrument` with the new A3, and `solutions` of the frames

    Raises
    ------
    FixError
        there is no fix, or the frames do not agree

    Examples
    --------
    >>> solver = starpos.Solver(starpos.Instrument(4635.9375), starpos.load_catalogue())
    >>> stars = [starpos.read_frame(path) for path in sorted(Path("night").glob("stars_*.csv"))]
    >>> tilts = starpos.read_tilt_csv("night/tilt.csv")
    >>> found = starpos.calibrate_at(solver, stars, tilts, starpos.Place.by_gravity(35.7046, 51.4106))
    >>> len(found.fixes)
    5
    """

    def find(readings: Readings, a3: np.ndarray) -> PlumbLine:
        sigma = np.hypot(site.plumb_stddev, np.sqrt(np.mean(readings.common2)))
        return hang(readings, a3, site.plumb_axes[2], float(sigma), np.radians(turn_stddev_deg))

    if not frames:
        raise FixError("there is no frame to calibrate from: give at least one")
    found = calibrate(solver, frames, tilts, find, fewest=1, progress=progress, known=known)
    if not found.fixes:
        raise FixError(f"no frame has a fix to calibrate from: {found.solutions[0].message}")
    if min(f.camera.rotation[:, 2] @ site.plumb_axes[2] for f in found.fixes) < 0:
        raise FixError(
            "from the place that was given the camera would look into the ground: check latitude and longitude, their "
            "order and signs, and the clock"
        )
    return found


def calibrate(
    solver: Solver,
    frames: Sequence[Stars | Pointing],
    tilts: Tilts,
    find: FindPlumbLine,
    fewest: int,
    progress: Progress = quiet,
    known: Known = NOTHING_KNOWN,
) -> Calibrated:
    """Solve the frames and `find` A3 from their fixes, again until it settles; with fewer fixes A3 stays as it was.

    Raises FixError if the frames do not agree.
    """
    given, inside = solver.instrument.calibration, solver.instrument.has_level_inside
    unknown = given if inside else Calibration.of(given.misalignment_deg)
    errors = solver.instrument.inclinometer
    solver = _with(solver, unknown, errors)
    solutions: list[Solution] = []
    hints: list[Hint | None] = [None] * len(frames)
    agreement: _Agreement | None = None
    for k in range(SOLVING_ROUNDS):
        solutions = []
        for n, (frame, hint) in enumerate(zip(frames, hints, strict=True)):
            if isinstance(frame, Pointing):
                solutions.append(solver.solve_pointing(frame, tilts))
            else:
                solutions.append(solver.solve(frame, tilts, hint, known=known.get(n)))
            progress("calibrating", (k + (n + 1) / len(frames)) / SOLVING_ROUNDS)
        hints = [s.hint for s in solutions]
        solved = [s.fix for s in solutions if s.fix]
        if len(solved) < fewest:
            break
        a3 = solver.instrument.calibration.a3
        agreement = _agreed(find, solved, a3, errors)
        now = replace(_calibration_of(agreement), covariance_arcsec2=given.covariance_arcsec2)
        solver = _with(solver, now if inside else _unknown(agreement), agreement.errors)
        # a turn about the plumb line changes no fix
        if k and np.linalg.norm(agreement.plumb.a3[2] - a3[2]) < SETTLED_RAD:
            break
    progress("calibrating", 1.0)
    if agreement is None:
        return Calibrated(solver.instrument, float(UNKNOWN_ARCSEC[0]), tuple(solutions))
    # the check waits for the end, because with a wrong A3 the errors are not known either
    agreement.check()
    plumb = agreement.plumb
    solutions = [agreement.judged(s) for s in solutions]
    if plumb.astray:
        solutions = [
            replace(s, fix=_with_zenith_error(s.fix, plumb.astray)) if s.fix else s for s in solutions
        ]
    error = float(plumb.stddev_across(agreement.readings.mean_plumb) / ARCSEC)
    instrument = replace(solver.instrument, calibration=_dated(agreement), inclinometer=agreement.errors)
    return Calibrated(instrument, error, tuple(solutions), agreement.beyond)


@dataclass(frozen=True, kw_only=True)
class _Agreement:
    """The plumb line of the frames that agree, and how well they do.

    readings: of the frames `sound`.  scatter: of these.  stated: errors of the inclinometer.
    left_out: utc_unix_s of each frame that disagrees, and by how much, in rad.
    """

    plumb: PlumbLine
    readings: Readings
    sound: list[Fix]
    scatter: Scatter
    left_out: dict[float, float]
    stated: InclinometerErrors

    @property
    def errors(self) -> InclinometerErrors:
        """The inclinometer's errors, with its noise and its poses' errors as these frames show them."""
        noise = self.stated.noise_rad
        own = float(np.sqrt(np.median(self.readings.sigma**2)))
        if self.scatter.evident and self.scatter.noise_sigma > NOISIER * own:
            samples = np.mean([f.tilt.samples for f in self.sound])
            noise = float(np.hypot(noise, self.scatter.noise_sigma * np.sqrt(samples)))
        return replace(self.stated, pose_rad=self.scatter.pose_sigma, noise_rad=noise)

    @property
    def beyond(self) -> str:
        """Say by how much the frames scatter beyond the stated errors, and what to state; '' if they do not."""
        found, stated, axes = self.errors, self.stated, self.sound[0].tilt.axes
        scales = slice(axes, 2 * axes)
        scale, known = self.plumb.response[scales], np.diag(self.plumb.response_covariance)[scales]
        shown = np.abs(scale) > SHOWN_SIGMA * np.sqrt(known + stated.scale**2)
        told, state = [], []
        if found.noise_rad > stated.noise_rad:
            noise = np.degrees(found.noise_rad)
            told.append(f"noise of {noise:.2g} deg a reading ({np.degrees(stated.noise_rad):.2g} stated)")
            state.append(f"tilt_noise_deg: {noise:.2g}")
        if self.scatter.evident and found.pose_rad > stated.pose_rad:
            told.append(
                f"{np.degrees(found.pose_rad):.2g} deg from pose to pose ({np.degrees(stated.pose_rad):.2g} stated)"
            )
            state.append(f"tilt_pose_arcsec: {found.pose_rad / ARCSEC:.2g}")
        if shown.any():
            worst = float(scale[np.argmax(np.abs(scale))])
            told.append(f"a scale that is {100 * worst:+.2g} % off ({100 * stated.scale:.2g} stated)")
            state.append(f"tilt_scale: {abs(worst):.2g}")
        if not told:
            return ""
        return (
            f"the tilts err by more than the inclinometer's stated errors: {', '.join(told)}; the errors "
            f"stated of A3 and the file written with it include this; in another instrument file, state "
            f"{', '.join(state)}"
        )

    def check(self) -> None:
        """Raise FixError if the frames are not of one zenith."""
        of = len(self.sound) + len(self.left_out)
        why = "the instrument was moved, its inclinometer or clock was disturbed, or the place given is wrong"
        if len(self.left_out) > MAX_OUTLIERS * of:
            raise FixError(
                f"{len(self.left_out)} of {of} frames disagree with the others on the zenith: {why}"
            )
        # root mean square in rad of what the fit leaves of the frames
        scatter = float(np.sqrt(np.mean(np.sum(self.plumb.left**2, 1))))
        # frames too few to show an error of the tilts must agree as they state
        shown = self.scatter.evident or self.scatter.response_evident
        if scatter > MAX_POSE_RAD or (self.plumb.scatter > MAX_SCATTER and not shown):
            raise FixError(
                f"{of} frames do not agree on one zenith (they scatter by "
                f"{np.degrees(scatter):.2f} deg): {why}"
            )

    def judged(self, solution: Solution) -> Solution:
        """The solution, without a fix if its frame disagrees."""
        if solution.fix is None:
            return solution
        off = self.left_out.get(solution.fix.utc_unix_s)
        if off is not None:
            place = solution.source or "a frame"
            why = f"{place}: its tilt is off by {off / ARCSEC:.0f} arcsec against those of the other frames"
            return replace(solution, status=Status.POOR_FIT, message=f"{why}: it is left out", fix=None)
        return solution


def _agreed(find: FindPlumbLine, solved: list[Fix], a3: np.ndarray, errors: InclinometerErrors) -> _Agreement:
    """The plumb line that `find` gives for the frames that agree with each other."""
    whole = Readings.of(solved, errors)
    rows, plumb = _agreeing(lambda rows: find(whole.subset(rows), a3), whole, errors.pose_rad)
    sound = [solved[k] for k in rows]
    # a fix with a bad tilt, hence a bad refraction, may have split the pose of the sound ones
    readings = replace(whole.subset(rows), pose=poses_of(sound))
    _, scatter = settled(plumb, readings)
    # once more about the answer, with the errors that the poses show
    noisy = np.hypot(readings.sigma, scatter.noise_sigma)
    again = find(replace(readings, pose_sigma=scatter.pose_sigma, sigma=noisy), a3)
    plumb, scatter = settled(again, readings)
    left_out = {}
    if len(rows) < len(solved):
        # how far the others are off shows against the answer of these
        off = np.linalg.norm(_left(whole, plumb), axis=1)
        for k in np.setdiff1d(np.arange(len(solved)), rows):
            left_out[solved[k].utc_unix_s] = float(off[k])
    return _Agreement(
        plumb=plumb, readings=readings, sound=sound, scatter=scatter, left_out=left_out, stated=errors
    )


def _agreeing(fit: FitOfRows, whole: Readings, pose_rad: float) -> tuple[np.ndarray, PlumbLine]:
    """Indices of the frames that agree with most of the others, and the plumb line of these.

    Of few poses the robust fit may end between sound and bad tilts. A second one begins with the frames that agree with
    their own poses, and the fit from which half of the frames are less far counts.
    """
    if (rows := _but_one(fit, whole)) is not None:
        return rows, fit(rows)
    starts, calm = [_unhidden(fit, whole)], _calm(whole)
    if (1 - MAX_OUTLIERS) * len(whole.pose) <= len(calm) < len(starts[0]):
        starts.append(calm)
    found = [_kept(fit, whole, pose_rad, rows) for rows in starts]
    return min(found, key=lambda f: typical(_left(whole, f[1]), 5))


def _kept(fit: FitOfRows, whole: Readings, pose_rad: float, rows: np.ndarray) -> tuple[np.ndarray, PlumbLine]:
    """The frames in `rows` without those that their plumb line shows to disagree, and the plumb line of the rest."""
    for _ in range(JUDGED):
        plumb = fit(rows)
        size = np.linalg.norm(plumb.left, axis=1)
        usual = np.hypot(whole.sigma[rows], max(typical(plumb.left, 5), pose_rad))
        agree = size < OUTLIER_SIGMA * usual
        if agree.all() or agree.sum() < (1 - MAX_OUTLIERS) * len(whole.pose):
            break
        rows = rows[agree]
    return rows, plumb


def _but_one(fit: FitOfRows, whole: Readings) -> np.ndarray | None:
    """Indices of a few frames without one that is alone wrong, by far; None if none is."""
    number = len(whole.pose)
    if not FEW_FRAMES <= number < MANY_POSES:
        return None
    stated = np.hypot(whole.sigma, whole.pose_sigma)
    if (np.linalg.norm(fit(np.arange(number)).left, axis=1) < OUTLIER_SIGMA * stated).all():
        return None
    apart, others = [], [np.delete(np.arange(number), k) for k in range(number)]
    for k, rows in enumerate(others):
        size = np.linalg.norm(_left(whole, fit(rows)), axis=1)
        apart.append(size[k] / max(size[rows].max(), stated[rows].max()))
    return others[int(np.argmax(apart))] if max(apart) > FAR_WRONG else None


def _calm(whole: Readings) -> np.ndarray:
    """Indices of the frames whose readings agree with the median of their pose, by how much most frames do."""
    off = np.empty_like(whole.plumb)
    for pose in range(whole.pose.max() + 1):
        rows = whole.pose == pose
        off[rows] = whole.plumb[rows] - np.median(whole.plumb[rows], axis=0)
    size = np.linalg.norm(off, axis=1)
    return np.flatnonzero(size < OUTLIER_SIGMA * np.maximum(whole.sigma, typical(off, 0)))


def _unhidden(fit: FitOfRows, whole: Readings) -> np.ndarray:
    """Indices of the frames without outliers that pull the fit of all towards them, and so seem to agree with it.

    Each is judged against a fit of the frames that lie closest to it, as many as must agree (least trimmed squares).
    Few poses fit almost anything; then these are all.
    """
    rows: np.ndarray = np.arange(len(whole.pose))
    most = int(np.ceil((1 - MAX_OUTLIERS) * len(rows)))
    if len(np.unique(whole.pose)) < MANY_POSES:
        return rows
    # the closest alone, until they are the same; then all that agree with them, until these are
    for closest in (True, False):
        for _ in range(JUDGED):
            left = _left(whole, fit(rows))
            usual = np.hypot(whole.sigma, max(typical(left[rows], 5), whole.pose_sigma))
            off = np.linalg.norm(left, axis=1) / usual
            before, rows = rows, np.sort(np.argsort(off, kind="stable")[:most])
            if not closest:
                rows = np.union1d(rows, np.flatnonzero(off < OUTLIER_SIGMA))
            if np.array_equal(before, rows):
                break
    return rows


def _left(whole: Readings, plumb: PlumbLine) -> np.ndarray:
    """Residuals (K, 3) in S of readings against a plumb line, whether it was fitted to them or not."""
    return whole.plumb - np.einsum("ij,kjl,l->ki", plumb.a3, whole.to_camera, plumb.zenith)


def _unknown(agreement: _Agreement) -> Calibration:
    """A3 as the budgets of the fixes take it: unknown, except for its turn about the plumb line if the leans show it.

    With an unknown turn every lean would become an error.
    """
    plumb, found = agreement.plumb, _calibration_of(agreement)
    up = found.up
    turn_arcsec = np.sqrt(up @ plumb.covariance @ up) / ARCSEC
    across, about = UNKNOWN_ARCSEC[0], min(UNKNOWN_ARCSEC[2], TURN_SIGMA * turn_arcsec)
    # the errors of single tilts would seem to determine the turn, unless the instrument really leans from pose to pose;
    # if it does and the turn stays unknown, `_with_zenith_error` accounts for it
    if plumb.astray or not agreement.readings.lean(agreement.scatter.pose_sigma):
        about = 0.0
    covariance = np.eye(3) * across**2 + np.outer(up, up) * (about**2 - across**2)
    return replace(found, covariance_arcsec2=tuple(map(tuple, covariance.tolist())))


def _with_zenith_error(fix: Fix, astray: float) -> Fix:
    """The fix with an error of the zenith (rad) that is the same for all frames, at any heading."""
    # with east, north, up for L
    level = level_rows(local_north(enu_axes(fix.latitude, fix.longitude)), fix.link_to_enu)
    term = ErrorTerm("turn", level[:, :2] * astray, shared=ALWAYS)
    return replace(fix, terms=(*fix.terms, term))


def _with(solver: Solver, calibration: Calibration, errors: InclinometerErrors) -> Solver:
    return replace(
        solver, instrument=replace(solver.instrument, calibration=calibration, inclinometer=errors)
    )


def _dated(agreement: _Agreement) -> Calibration:
    """The calibration at the mean time, temperature and tilt of the frames."""
    sound = agreement.sound
    return replace(
        _calibration_of(agreement),
        covariance_arcsec2=tuple(map(tuple, (agreement.plumb.covariance / ARCSEC**2).tolist())),
        utc_unix_s=float(np.mean([f.utc_unix_s for f in sound])),
        frames=len(sound),
        valid_days=VALID_DAYS,
    )


def _calibration_of(agreement: _Agreement) -> Calibration:
    """The A3 that was found, at the mean temperature and tilt of the frames, with the response if the poses show it."""
    plumb, axes = agreement.plumb, agreement.sound[0].tilt.axes
    found = Calibration(
        temperature_c=mean_known(np.array([f.tilt.temperature_c for f in agreement.sound])),
        tilt_deg=tuple(np.degrees(angles_at(agreement.readings.mean_plumb, axes)).tolist()),
    ).turned_to(plumb.a3)
    stated = np.diag(stated_variances(agreement.stated, axes))
    known, most = np.sqrt(np.diag(plumb.response_covariance)), np.sqrt(np.diag(stated))
    # few poses show no response, nor do poses that scatter so much that they will be refused
    enough = agreement.readings.pose.max() + 1 >= MIN_POSES
    told = enough and (np.abs(known - most) > WORTH * np.maximum(known, most)).any()
    if not told or agreement.scatter.pose_sigma > MAX_POSE_RAD:
        return found
    return replace(
        found,
        response=tuple(plumb.response.tolist()),
        response_covariance=tuple(map(tuple, plumb.response_covariance.tolist())),
    )


def turn(
    solver: Solver,
    frames: Sequence[Stars | Pointing],
    tilts: Tilts,
    turn_stddev_deg: float = 180.0,
    progress: Progress = quiet,
    known: Known = NOTHING_KNOWN,
) -> Calibrated:
    """A3, and fixes, from frames of one place at several headings; the solver's A3 need not be near.

    The `average` of the fixes is the place; its covariance says how well the headings separate it from A3.  With fewer
    than two fixes A3 stays as it was.

    Parameters
    ----------
    solver : of the instrument
    frames : lists of stars, or pointings of another program
    tilts : of their times
    turn_stddev_deg : sigma of the turn of the solver's A3 about the plumb line. It matters if the axis of the turn
        leans.
    progress : is called with the share of the work that is done
    known : the stars of frames, by the frames' numbers, that only a longer search identifies than the solver's

    Returns
    -------
    Calibrated
        `instrument` with the new A3, and `solutions` of the frames

    Raises
    ------
    FixError
        the instrument leans and the headings leave two places, or the frames have no common zenith

    Examples
    --------
    >>> solver = starpos.Solver(starpos.Instrument(4635.9375), starpos.load_catalogue())
    >>> stars = [starpos.read_frame(path) for path in sorted(Path("turn").glob("stars_*.csv"))]
    >>> tilts = starpos.read_tilt_csv("turn/tilt.csv")
    >>> starpos.average(starpos.turn(solver, stars, tilts).fixes)
    <Average of 8 frames: +35.7... +51.4... +- ...>
    """

    if solver.instrument.has_level_inside:
        turn_stddev_deg = min(turn_stddev_deg, solver.instrument.calibration.turn_stddev_deg)

    def find(readings: Readings, a3: np.ndarray) -> PlumbLine:
        return level(readings, a3, np.radians(turn_stddev_deg))

    return calibrate(solver, frames, tilts, find, fewest=2, progress=progress, known=known)


# the level that the camera is for itself has no direction to face
TURN_DEG = 1e-3


def calibrate_fixed(
    solver: Solver,
    frames: Sequence[Stars | Pointing],
    site: Place,
    sag_arcsec_per_sqrt_hour: float = SAG_ARCSEC_PER_SQRT_HOUR,
    progress: Progress = quiet,
    known: Known = NOTHING_KNOWN,
) -> Calibrated:
    """The instrument with the camera's own vertical, from frames of a camera at rest at a known astronomic place.

    known: the stars of frames, as `calibrate_at` has them.
    Raises FixError if there is no fix, the frames do not agree, or the camera was touched between them.
    """
    level = level_errors(sag_arcsec_per_sqrt_hour)
    bare = replace(
        solver,
        instrument=replace(solver.instrument, inclinometer=level, inclinometer_model="", vertical=None),
    )
    found = calibrate_at(bare, frames, OWN_LEVEL, site, TURN_DEG, progress, known)
    fixes = found.fixes
    if poses_of(fixes).any():
        raise FixError(
            "the camera was touched between the frames, or their clock was set: give frames of a camera "
            "that nothing moved"
        )
    attitudes = np.array([f.camera.rotation for f in fixes])
    mean = rotation.mean_rotation(attitudes)
    covariance = np.mean([f.camera.covariance for f in fixes], axis=0) / ARCSEC**2
    vertical = CameraVertical(*(tuple(map(tuple, m.tolist())) for m in (mean, covariance)))
    # a level that always reads zero has no response
    calibration = replace(found.instrument.calibration, response=(), response_covariance=())
    return replace(
        found,
        instrument=replace(found.instrument, calibration=calibration, inclinometer=level, vertical=vertical),
    )

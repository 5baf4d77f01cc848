# SPDX-License-Identifier: Apache-2.0
"""A3 from frames: at a known place, or at several headings of an unknown place (turning.py)."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from starpos import rotation
from starpos.calibration.plumb_line import UNKNOWN_ARCSEC, FixedFrame, PlumbLine, Readings, hang
from starpos.earth.ellipsoid import EARTH_RADIUS_M, curvature_radii_m
from starpos.errors import FixError
from starpos.fix.budget import ALWAYS, ErrorTerm, heading_of
from starpos.fix.fix import Fix
from starpos.fix.solver import Solution, Solver
from starpos.frames.stars import Stars
from starpos.identification.hint import Hint
from starpos.instrument.inclinometer import Tilt, a2_matrix
from starpos.instrument.instrument import MOST_C, Calibration, Instrument
from starpos.progress import Progress, quiet
from starpos.sky.site import Site
from starpos.units import ARCSEC

ROUNDS = 4
SETTLED_RAD = 0.02 * ARCSEC
# terms that move the zenith, of all frames about alike
OF_PLACE = ("refraction", "clock", "time stamp", "ut1", "pole")
VALID_DAYS = 365.0
# chi-square per degree of freedom that frames of one zenith may have
MOST_SCATTER = 4.0
# the fixes use so many times the sigma of A3's turn that the leans gave, because both come from the same tilts
TURN_SIGMA = 3.0
# frames further off are left out, up to this share of all
OUTLIER_SIGMA, MOST_OUTLIERS = 6.0, 0.25

# the tilt at (mid_unix_s, exposure_s, spread_s)
Tilts = Callable[[float, float, float], Tilt]
# A3 and the zenith from readings, A3 as it is, and the fixes
FindPlumbLine = Callable[[Readings, np.ndarray, list[Fix]], PlumbLine]


@dataclass(frozen=True)
class Calibrated:
    """An instrument with its new A3, and each frame solved with it.

    plumb_stddev_arcsec: sigma of the plumb line in the camera, on the worse of two axes.
    The budgets of the fixes take A3 as unknown, because the calibration was made from the same frames.
    """

    instrument: Instrument
    plumb_stddev_arcsec: float
    solutions: tuple[Solution, ...]

    @property
    def fixes(self) -> list[Fix]:
        """The fixes of the frames that have one."""
        return [s.fix for s in self.solutions if s.fix]


def calibrate_at(
    solver: Solver,
    frames: Sequence[Stars],
    tilt: Tilts,
    site: Site,
    site_stddev_arcsec: float = 0.0,
    turn_stddev_deg: float = 180.0,
    progress: Progress = quiet,
) -> Calibrated:
    """A3 from one or more frames at a known astronomic place; the solver's A3 need not be near.

    tilt: a function of (mid_unix_s, exposure_s, spread_s).
    site_stddev_arcsec: sigma of the place.
    turn_stddev_deg: sigma of the turn of the solver's A3 about the plumb line.  One lean of the instrument does not tell
    that turn, and only a fix at another lean needs it; the covariance shows it.
    Raises FixError if there is no fix or the frames do not agree.
    """

    def find(readings: Readings, a3: np.ndarray, fixes: list[Fix]) -> PlumbLine:
        common = sum(np.trace(t.covariance[:2, :2]) / 2 for f in fixes for t in f.terms if t.name in OF_PLACE)
        sigma = np.hypot(site_stddev_arcsec * ARCSEC, np.sqrt(common / len(fixes)) / EARTH_RADIUS_M)
        return hang(readings, a3, site.enu[2], float(sigma), np.radians(turn_stddev_deg))

    if not frames:
        raise FixError("there is no frame to calibrate from: give at least one")
    found = calibrate(solver, frames, tilt, find, fewest=1, progress=progress)
    if not found.fixes:
        raise FixError(f"no frame has a fix to calibrate from: {found.solutions[0].message}")
    if min(f.camera_to_itrs[:, 2] @ site.enu[2] for f in found.fixes) < 0:
        raise FixError(
            "from the place that was given the camera would look into the ground: check latitude and longitude, their "
            "order and signs, and the clock"
        )
    return found


def calibrate(
    solver: Solver,
    frames: Sequence[Stars],
    tilt: Tilts,
    find: FindPlumbLine,
    fewest: int,
    progress: Progress = quiet,
) -> Calibrated:
    """Solve the frames and `find` A3 from their fixes, again until it settles; with fewer fixes A3 stays as it was.

    Raises FixError if the frames do not agree.
    """
    unknown = Calibration.of(solver.instrument.calibration.misalignment_deg, UNKNOWN_ARCSEC)
    solver = _with(solver, unknown)
    solutions: list[Solution] = []
    hints: list[Hint | None] = [None] * len(frames)
    plumb: PlumbLine | None = None
    sound: list[FixedFrame] = []
    for k in range(ROUNDS):
        solutions = []
        for n, (stars, hint) in enumerate(zip(frames, hints, strict=True)):
            solutions.append(solver.solve(stars, tilt, hint))
            progress("calibrating", (k + (n + 1) / len(frames)) / ROUNDS)
        hints = [s.hint for s in solutions]
        solved = [FixedFrame(s.fix, s.tilt) for s in solutions if s.fix and s.tilt]
        if len(solved) < fewest:
            break
        a3 = solver.instrument.mounting.a3
        plumb, sound = _found(find, solved, solver.instrument)
        solver = _with(solver, _unknown(plumb, sound))
        # a turn about the plumb line changes no fix
        if k and np.linalg.norm(plumb.a3[2] - a3[2]) < SETTLED_RAD:
            break
    progress("calibrating", 1.0)
    if plumb is None:
        return Calibrated(solver.instrument, float(UNKNOWN_ARCSEC[0]), tuple(solutions))
    # the check waits for the end, because with a wrong A3 the errors are not known either
    if plumb.scatter > _most_scatter(len(sound)):
        raise FixError(
            f"{len(sound)} frames do not agree on one zenith (chi-square {plumb.scatter:.0f} a degree of freedom): the "
            "instrument was moved between them, its inclinometer or clock was disturbed, or the place given is wrong"
        )
    if plumb.scatter > _usual_scatter(len(sound)):
        plumb = replace(plumb, covariance=plumb.covariance * plumb.scatter)
        solutions = [_scattered(s, plumb.scatter) for s in solutions]
    if plumb.astray:
        solutions = [
            replace(s, fix=_with_zenith_error(s.fix, plumb.astray)) if s.fix else s for s in solutions
        ]
    mean_plumb = Readings.of(sound, solver.instrument.inclinometer).mean_plumb
    error = float(plumb.stddev_across(mean_plumb) / ARCSEC)
    instrument = replace(solver.instrument, calibration=_dated(plumb, sound))
    return Calibrated(instrument, error, tuple(solutions))


def _found(
    find: FindPlumbLine, solved: list[FixedFrame], instrument: Instrument
) -> tuple[PlumbLine, list[FixedFrame]]:
    """The plumb line that `find` gives for the frames that agree with each other, and these frames."""
    a3, errors = instrument.mounting.a3, instrument.inclinometer
    plumb = find(Readings.of(solved, errors), a3, [s.fix for s in solved])
    sound = [s for s, off in zip(solved, plumb.off, strict=True) if off < OUTLIER_SIGMA]
    if not 0 < len(solved) - len(sound) <= MOST_OUTLIERS * len(solved):
        return plumb, solved
    return find(Readings.of(sound, errors), a3, [s.fix for s in sound]), sound


def _unknown(plumb: PlumbLine, sound: list[FixedFrame]) -> Calibration:
    """A3 as the budgets of the fixes take it: unknown, except for its turn about the plumb line if the leans told that.

    With an unknown turn every lean would become an error.
    """
    tilt_deg = _mean_tilt_deg(sound)
    up = a2_matrix(*np.radians(tilt_deg))[2]
    turn_arcsec = np.sqrt(up @ plumb.covariance @ up) / ARCSEC
    across, about = UNKNOWN_ARCSEC[0], min(UNKNOWN_ARCSEC[2], TURN_SIGMA * turn_arcsec)
    # `_with_zenith_error` accounts for the turn then; here the noise of single tilts would seem to tell it
    if plumb.astray:
        about = 0.0
    covariance = np.eye(3) * across**2 + np.outer(up, up) * (about**2 - across**2)
    held = Calibration(
        covariance_arcsec2=tuple(map(tuple, covariance.tolist())),
        temperature_c=_mean_temperature_c(sound),
        tilt_deg=tilt_deg,
    )
    return held.turned_to(plumb.a3)


def _most_scatter(frames: int) -> float:
    """Chi-square per degree of freedom that sound frames may have; few frames may have more."""
    # slow to import
    from scipy.special import gammainccinv

    freedom = max(2 * frames - 5, 1)
    return max(MOST_SCATTER, 2 * float(gammainccinv(freedom / 2, 1e-9)) / freedom)


def _scattered(solution: Solution, scatter: float) -> Solution:
    """The solution with the tilt's error enlarged to the scatter of the frames."""
    if solution.fix is None:
        return solution
    terms = tuple(
        replace(t, variance=t.variance * scatter) if t.name == "tilt" else t for t in solution.fix.terms
    )
    return replace(solution, fix=replace(solution.fix, terms=terms))


def _with_zenith_error(fix: Fix, astray: float) -> Fix:
    """The fix with an error of the zenith (rad) that is the same for all frames, at any heading."""
    here, step = np.array([fix.latitude, fix.longitude]), 1e-6
    link = Site(*np.degrees(here)).enu.T @ fix.link_to_enu
    prime, meridian = curvature_radii_m(fix.latitude)
    # latitude, longitude in rad for a metre east, north
    moves = ((0.0, 1 / (prime * max(np.cos(fix.latitude), 1e-9))), (1 / meridian, 0.0))
    columns: list[list[float]] = []
    for metre, attitude in zip(
        moves, ((0, 1 / prime, np.tan(fix.latitude) / prime), (-1 / meridian, 0, 0)), strict=True
    ):
        there = here + np.array(metre) * step * prime
        turned = heading_of(Site(*np.degrees(there)).enu @ link) - fix.heading
        columns.append([*np.eye(2)[len(columns)], rotation.half_turn(turned) / (step * prime), *attitude])
    term = ErrorTerm("turn", np.array(columns).T * astray * EARTH_RADIUS_M, shared=ALWAYS)
    return replace(fix, terms=(*fix.terms, term))


def _usual_scatter(frames: int) -> float:
    """Chi-square per degree of freedom that frames with rightly stated errors usually stay below."""
    return 1 + 2 * np.sqrt(2 / max(2 * frames - 5, 1))


def _with(solver: Solver, calibration: Calibration) -> Solver:
    return replace(solver, instrument=replace(solver.instrument, calibration=calibration))


def _dated(plumb: PlumbLine, solved: list[FixedFrame]) -> Calibration:
    """The calibration at the mean time, temperature and tilt of the frames."""
    found = Calibration(
        covariance_arcsec2=tuple(map(tuple, (plumb.covariance / ARCSEC**2).tolist())),
        utc_unix_s=float(np.mean([s.fix.utc_unix_s for s in solved])),
        temperature_c=_mean_temperature_c(solved),
        tilt_deg=_mean_tilt_deg(solved),
        frames=len(solved),
        valid_days=VALID_DAYS,
    )
    return found.turned_to(plumb.a3)


def _mean_temperature_c(solved: list[FixedFrame]) -> float:
    # an unknown temperature is NaN, which is not below MOST_C
    known = [s.tilt.temperature_c for s in solved if abs(s.tilt.temperature_c) < MOST_C]
    return float(np.mean(known)) if known else float("nan")


def _mean_tilt_deg(solved: list[FixedFrame]) -> tuple[float, float]:
    x, y = np.degrees(np.mean([[s.tilt.theta_x, s.tilt.theta_y] for s in solved], axis=0))
    return float(x), float(y)

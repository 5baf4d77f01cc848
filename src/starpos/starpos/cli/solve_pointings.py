# SPDX-License-Identifier: Apache-2.0
"""`starpos solve --pointings`: place and heading from what a plate solver found; without a roll, the place alone."""

import argparse
from collections.abc import Sequence

import numpy as np

from starpos.averaging.altitudes import Circle, circle_of, place_of_circles
from starpos.cli import console, options
from starpos.cli.archive import NightFolder
from starpos.cli.deflection import tell_unknown, vertical_of
from starpos.cli.doubts import Near, checked_tilts, far, near_of
from starpos.cli.fix_output import COLUMNS, HEAD, json_of, put_combined
from starpos.cli.frame_work import NO_CAMERA
from starpos.cli.output import Output
from starpos.cli.solved_night import NO_FIX, check_save, solved_by_turning, tell
from starpos.earth.vertical import Vertical
from starpos.errors import FixError, InstrumentError, StarposError
from starpos.fix.pointing import IDEAL
from starpos.fix.solution import status_of
from starpos.fix.solver import Solver
from starpos.frames.pointings import Pointing, read_pointings
from starpos.instrument.tilt_log import TiltLog
from starpos.sky import catalogue
from starpos.utc import utc_text

# the status of a row that tells an elevation
ELEVATION = "elevation alone"
ELEVATIONS_HEAD = "row: how far from the zenith its direction is; together these tell the place"


def run(args: argparse.Namespace) -> int:
    """Work on the table of --pointings; returns the exit status."""
    near = near_of(args)
    pointings, vertical = read_pointings(args.pointings), vertical_of(args)
    own_level = options.has_own_level(args)
    if args.tilt is None and not own_level:
        raise InstrumentError("--pointings needs the tilts: give --tilt CSV")
    if args.jobs is not None or args.scheduler is not None:
        raise InstrumentError("--jobs and --scheduler are for frames: --pointings are worked in a moment")
    solver, saving = _solver_of(args), 0
    check_save(args, solver.instrument)
    log = None if own_level else checked_tilts("solve", args.tilt, solver.instrument)
    whole = [p for p in pointings if p.has_roll]
    output = Output(args, COLUMNS, HEAD if whole else ELEVATIONS_HEAD)
    if not whole:
        if args.self_calibrate:
            raise InstrumentError(
                "--self-calibrate needs pointings with their roll: elevations alone do not tell A3"
            )
        return _from_elevations(args, output, solver, log, pointings, vertical, near)
    night = NightFolder(tuple(p.source for p in pointings), args.tilt)
    if args.self_calibrate and log is not None:
        turned, saving = solved_by_turning(args, night, solver, log, whole)
        solved = iter(turned)
        answers = [next(solved) if p.has_roll else solver.solve(p) for p in pointings]
    else:
        answers = [solver.solve(p, None if log is None else log.average) for p in pointings]
    given = None if args.self_calibrate else solver.instrument
    return max(saving, tell(args, output, night, zip(night.frames, answers, strict=True), vertical, given))


def _solver_of(args: argparse.Namespace) -> Solver:
    """The solver for pointings, which needs no focal length."""
    instrument = options.instrument_of(args, NO_CAMERA)
    return Solver(instrument, catalogue.load_catalogue(), options.atmosphere_of(args))


def _from_elevations(
    args: argparse.Namespace,
    output: Output,
    solver: Solver,
    log: TiltLog | None,
    pointings: Sequence[Pointing],
    vertical: Vertical,
    near: Near | None,
) -> int:
    """Print the zenith distance of each row and the place that they tell together; returns the exit status."""
    circles: list[Circle] = []
    for p in pointings:
        try:
            circles.append(_circle(solver, log, p))
            zenith_distance, status = circles[-1].zenith_distance, ELEVATION
        except StarposError as e:
            console.complain("solve", e)
            zenith_distance, status = None, status_of(p, e).value
        _put_row(output, p, zenith_distance, status, vertical)
    together = None
    if circles:
        try:
            together = place_of_circles(circles, None if near is None else (near.latitude, near.longitude))
            tell_unknown("solve", args, vertical.at(together.latitude, together.longitude))
        except FixError as e:
            console.complain("solve", e)
        about = {}
        if near is not None and together is not None:
            about = {"km_from_near": near.km_from(together.latitude, together.longitude)}
            if away := far(near, together, None, ()):
                console.complain("solve", away)
        put_combined(output, NightFolder((), args.tilt), together, [], set(), vertical, about)
    return 0 if together else NO_FIX


def _circle(solver: Solver, log: TiltLog | None, pointing: Pointing) -> Circle:
    state, tilt = solver.levelled(pointing, None if log is None else log.average)
    instrument = solver.instrument
    return circle_of(
        pointing,
        instrument.camera or IDEAL,
        tilt,
        instrument.mounting,
        solver.atmosphere,
        state,
        solver.clock_stddev_s(pointing),
    )


def _put_row(
    output: Output,
    pointing: Pointing,
    zenith_distance: float | None,
    status: str,
    vertical: Vertical,
) -> None:
    deg = None if zenith_distance is None else np.degrees(zenith_distance)
    utc = {} if pointing.mid_unix_s is None else {"utc": utc_text(pointing.mid_unix_s)}
    none = dict.fromkeys(("residual_arcsec", "log_odds"))
    about_stars = {"stars_detected": 0, "stars_matched": 0} | none | {"status": status, "warnings": []}
    row = json_of(None, vertical) | utc | {"zenith_distance_deg": deg} | about_stars
    about = status if deg is None else f"{deg:.5f} deg from the zenith"
    output.put({"file": pointing.source} | row, f"{pointing.source}: {about}")

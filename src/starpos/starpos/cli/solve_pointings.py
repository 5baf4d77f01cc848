# SPDX-License-Identifier: Apache-2.0
"""`starpos solve --pointings`: place and heading from what a plate solver found; without a roll, the place alone."""

import argparse
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from starpos.calibration.axis import FoundAxis
from starpos.cli import console, options
from starpos.cli.archive import NightFolder
from starpos.cli.fix_output import COLUMNS, HEAD, json_of, put_combined
from starpos.cli.inputs import checked_tilts, near_of
from starpos.cli.output import Output
from starpos.cli.overwriting import save_instrument
from starpos.cli.solved_night import NO_FIX, check_save, say, tell, tell_turned
from starpos.cli.vertical import tell_unknown, vertical_of
from starpos.earth.vertical import Vertical
from starpos.errors import InstrumentError, StarposError
from starpos.fix.solution import status_of
from starpos.fix.solver import Solver
from starpos.frames.pointings import Pointing, read_pointings
from starpos.instrument.tilts import NO_TILTS, Tilts
from starpos.night.doubts import Near
from starpos.night.elevations import from_elevations
from starpos.night.reading import NO_CAMERA
from starpos.night.remarks import WORTH_SAVING_ARCSEC
from starpos.night.together import turned
from starpos.sky import catalogue
from starpos.utc import utc_text

# the status of a row that gives an elevation
ELEVATION = "elevation alone"
ELEVATIONS_HEAD = "row: the zenith distance of its direction; together these give the position"


def run(args: argparse.Namespace) -> int:
    """Solve the table of --pointings; returns the exit status."""
    near = near_of(args)
    pointings, vertical = read_pointings(args.pointings), vertical_of(args)
    own_level = options.has_own_level(args)
    if args.tilt is None and not own_level:
        raise InstrumentError("--pointings needs the tilts: give --tilt CSV")
    if args.jobs is not None or args.scheduler is not None:
        raise InstrumentError("--jobs and --scheduler are for frames: --pointings take only a moment")
    solver, saving = _solver_of(args), 0
    check_save(args, solver.instrument)
    tilts = NO_TILTS if own_level else checked_tilts("solve", args.tilt, solver.instrument)
    whole = [p for p in pointings if p.has_roll]
    output = Output(args, COLUMNS, HEAD if whole else ELEVATIONS_HEAD)
    if not whole:
        return _from_elevations(args, output, solver, tilts, pointings, vertical, near)
    night = NightFolder(tuple(p.source for p in pointings), args.tilt)
    if args.self_calibrate:
        found = turned(solver, [(p, None) for p in whole], tilts, options.turn_of(args))
        saving, solved = tell_turned(args, night, found), iter(found.solutions)
        answers = [next(solved) if p.has_roll else solver.solve_pointing(p) for p in pointings]
    else:
        answers = [solver.solve_pointing(p, tilts) for p in pointings]
    given = None if args.self_calibrate else solver.instrument
    status, _ = tell(args, output, night, zip(night.frames, answers, strict=True), vertical, given)
    return max(saving, status)


def _solver_of(args: argparse.Namespace) -> Solver:
    """The solver for pointings, which needs no focal length."""
    instrument = options.instrument_of(args, NO_CAMERA)
    return Solver(instrument, catalogue.load_catalogue(), options.atmosphere_of(args))


def _from_elevations(
    args: argparse.Namespace,
    output: Output,
    solver: Solver,
    tilts: Tilts,
    pointings: Sequence[Pointing],
    vertical: Vertical,
    near: Near | None,
) -> int:
    """Print each row's zenith distance and the place that they give together; returns the exit status."""
    found = from_elevations(solver, pointings, tilts, near, args.self_calibrate)
    for p, circle in zip(pointings, found.circles, strict=True):
        if isinstance(circle, StarposError):
            console.complain("solve", circle)
            _put_row(output, p, None, status_of(p, circle).value, vertical)
        else:
            _put_row(output, p, circle.zenith_distance, ELEVATION, vertical)
    whole, night = found.together, NightFolder((), args.tilt)
    saving = 0
    if found.axis is not None:
        say(
            night,
            f"A3 from the elevations: the frame's centre in the inclinometer to {found.axis.stddev_arcsec:.0f} arcsec",
        )
    if args.save is not None:
        saving = _save(args, solver, found.axis)
    say(night, *([whole.why_not] if whole.why_not else ()), *whole.remarks)
    place, about = whole.average, {}
    if place is not None:
        tell_unknown("solve", args, vertical.at(place.latitude, place.longitude))
        about = {} if near is None else {"km_from_near": near.km_from(place.latitude, place.longitude)}
    if place is not None or whole.why_not:
        put_combined(output, night, place, [], set(), vertical, about)
    return max(saving, 0 if place else NO_FIX)


def _save(args: argparse.Namespace, solver: Solver, axis: FoundAxis | None) -> int:
    """Write the A3 that the elevations determined, as --save asks; NO_FIX if they did not."""
    if axis is None or axis.stddev_arcsec > WORTH_SAVING_ARCSEC:
        console.complain("solve", f"{args.save} is not written: the elevations hardly determine A3")
        return NO_FIX
    calibration = axis.calibration(solver.instrument.calibration, options.turn_of(args))
    about = f"A3 of elevations alone: the frame's centre to {axis.stddev_arcsec:.2f} arcsec"
    save_instrument("solve", args.save, replace(solver.instrument, calibration=calibration), about)
    return 0


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

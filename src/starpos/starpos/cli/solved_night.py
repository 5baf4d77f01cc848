# SPDX-License-Identifier: Apache-2.0
"""What the solutions of a night come to: a line each, A3 where the night tells it, the place of all together."""

import argparse
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

from starpos.averaging.average import Average, average
from starpos.calibration.turning import turn
from starpos.calibration.unknown import TELL_IT, at_another_lean, may_turn, unknown_a3
from starpos.cli import console, options
from starpos.cli.archive import NightFolder
from starpos.cli.deflection import tell_unknown
from starpos.cli.doubts import Levelled, Near, far, mistaken, near_of
from starpos.cli.fix_output import Solved, json_about, json_of, line_of, put_combined
from starpos.cli.output import Output
from starpos.cli.overwriting import save_instrument
from starpos.earth.vertical import Vertical
from starpos.errors import FixError, FrameError, StarposError
from starpos.fix.fix import Fix
from starpos.fix.solution import Solution, Status
from starpos.fix.solver import Solver
from starpos.frames.pointings import Pointing
from starpos.frames.stars import Stars
from starpos.instrument import instrument_update
from starpos.instrument.instrument import Instrument
from starpos.instrument.tilt_log import TiltLog
from starpos.utc import utc_text

NO_FIX = 1
WORTH_SAVING_ARCSEC = 600.0


def tell(
    args: argparse.Namespace,
    output: Output,
    night: NightFolder,
    rows: Iterable,
    vertical: Vertical,
    instrument: Instrument | None = None,
    fits: Callable[[str], None] | None = None,
) -> int:
    """Write (path, Solution or FrameError) of each frame, and their average; returns the exit status.

    instrument: that whose A3 was taken as it is; None where it was found by turning.
    fits: says which focal length fits a frame that was not identified.
    """
    solved: list[Solved] = []
    warnings: set[str] = set()
    unreadable, lost = False, ""
    for path, answer in rows:
        if isinstance(answer, FrameError):
            unreadable = True
            answer = Solution(Status.BAD_INPUT, str(answer), source=path, utc_unix_s=None, stars_detected=0)
        warnings |= set(answer.warnings)
        if answer.status is Status.NOT_IDENTIFIED:
            lost = lost or path
        if answer.fix:
            solved.append(Solved.of(answer, answer.fix))
        else:
            console.complain("solve", answer.message)
        output.put(
            {"file": path} | json_of(answer.fix, vertical) | json_about(answer),
            line_of(path, answer, args.self_calibrate),
        )
    if lost and not solved and fits is not None:
        fits(lost)
    console.tell_extrapolation("solve", solved)
    together = _combine(night, solved)
    if solved:
        last, near = solved[-1].fix, near_of(args)
        whole = last if together is None else together
        tell_unknown("solve", args, vertical.at(last.latitude, last.longitude))
        if instrument is not None and (
            unknown := unknown_a3(instrument.calibration, whole.covariance, whole.terms)
        ):
            _say(night, unknown)
        _tell_doubts(night, instrument, solved, whole, near)
        about = {} if near is None else {"km_from_near": near.km_from(whole.latitude, whole.longitude)}
        put_combined(output, night, together, solved, warnings, vertical, about)
    return console.UNREADABLE if unreadable else 0 if together else NO_FIX


def _tell_doubts(
    night: NightFolder,
    instrument: Instrument | None,
    solved: list[Solved],
    whole: Fix | Average,
    near: Near | None,
) -> None:
    """Complain about places that tilts must have set apart, or a place that lies far from `near`."""
    given = instrument is not None and instrument.vertical is None and not instrument.calibration.unknown
    mounting = instrument.mounting if instrument is not None and given else None
    frames = [Levelled(s.fix.camera_to_itrs, s.tilt) for s in solved if s.tilt is not None]
    if mounting is not None and (apart := mistaken(mounting, frames)):
        _say(night, apart)
    if near is not None and (away := far(near, whole, mounting, frames[-1:])):
        _say(night, away)


def check_save(args: argparse.Namespace, instrument: Instrument) -> None:
    """Raise InstrumentError if the file of --save is there and is of another instrument."""
    if args.save is not None:
        instrument_update.check_fits(Path(args.save), instrument)


def solved_by_turning(
    args: argparse.Namespace,
    night: NightFolder,
    solver: Solver,
    tilts: TiltLog,
    frames: Sequence[Stars | Pointing],
) -> tuple[Sequence[Solution], int]:
    """Find A3 and the solutions of a night's frames, and write A3 as --save asks.

    Returns the solutions, and the exit status of saving: NO_FIX where nothing is worth saving.
    """
    try:
        turned = turn(solver, frames, tilts.average, options.turn_of(args), solver.progress)
    except FixError as e:
        return [Solution.failed(stars, Status.POOR_FIT, str(e)) for stars in frames], NO_FIX
    error = f"the plumb line in the camera is known to {turned.plumb_stddev_arcsec:.2f} arcsec"
    if turned.plumb_stddev_arcsec > WORTH_SAVING_ARCSEC:
        kept = "" if args.save is None else f" {args.save} is not written:"
        _say(night, f"not calibrated:{kept} the headings hardly tell A3, {error}: turn it further")
        return turned.solutions, 0 if args.save is None else NO_FIX
    if args.save is not None:
        save_instrument("solve", args.save, turned.instrument, f"A3 by turning on the spot: {error}")
    kept = "--save OUT keeps A3 and its errors" if args.save is None else f"{args.save} is written"
    found = turned.instrument.calibration
    _say(night, f"calibrated: {error}; {kept}; {at_another_lean(found)}")
    if may_turn(found):
        _say(night, f"to use A3 at another lean, {TELL_IT}")
    return turned.solutions, 0


def _say(night: NightFolder, text: StarposError | str) -> None:
    """Print a line about a whole night on standard error."""
    console.complain("solve", text if night.folder is None else f"{night.folder}: {text}")


def _combine(night: NightFolder, solved: list[Solved]) -> Average | None:
    """The average of all fixes; None, with a line on standard error, if they do not belong together."""
    if not solved:
        return None
    try:
        whole = average([s.fix for s in solved])
    except FixError as e:
        _say(night, e)
        return None
    if whole.moved:
        begin = utc_text(whole.began_unix_s)
        _say(night, f"the instrument moved on: the average is of the {whole.frames} frames since {begin}")
    if whole.left_out:
        _say(night, f"{whole.left_out} fixes lie far from the others and are left out of the average")
    return whole

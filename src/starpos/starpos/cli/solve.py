# SPDX-License-Identifier: Apache-2.0
"""`starpos solve`: position and heading from frames with their tilts, for each frame and for all together."""

import argparse
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from starpos.averaging.average import Average, average
from starpos.calibration.turning import turn
from starpos.calibration.unknown import unknown_a3
from starpos.cli import common, jobs
from starpos.cli.archive import NightFolder, frames_among, nights_of
from starpos.cli.deflection import add_vertical, tell_unknown, vertical_of
from starpos.cli.doubts import Levelled, Near, add_near, checked_tilts, far, mistaken, near_of
from starpos.cli.fix_output import (
    COLUMNS,
    CSV_HELP,
    HEAD,
    JSON_HELP,
    Solved,
    json_about,
    json_of,
    line_of,
    put_combined,
)
from starpos.cli.frame_work import About, Listing, Look, Reader, Solving, reader_of
from starpos.cli.output import Output, add_formats
from starpos.cli.what_fits import say_what_would_fit
from starpos.earth.vertical import Vertical
from starpos.errors import FixError, FrameError, InstrumentError, StarposError, TiltError
from starpos.fix.fix import Fix
from starpos.fix.solver import Solution, Solver, Status
from starpos.frames.pointings import Pointing
from starpos.frames.stars import Stars
from starpos.instrument import instrument_file
from starpos.instrument.instrument import Instrument
from starpos.instrument.tilt_log import TiltLog
from starpos.sky import catalogue
from starpos.utc import utc_text

NO_FIX = 1
WORTH_SAVING_ARCSEC = 600.0


def define(parser: argparse.ArgumentParser) -> None:
    common.add_frames(parser, pointings=True)
    add_formats(parser, JSON_HELP, CSV_HELP)
    parser.add_argument(
        "--tilt",
        metavar="CSV",
        help="utc_unix_s, theta_x_deg, theta_y_deg[, theta_z_deg, temperature_c, sigma_deg]; not with nights: folders of "
        "frames with tilt.csv, nor with the instrument file of a camera fixed to the ground",
    )
    common.add_stamps(parser)
    common.add_instrument(parser)
    common.add_air(parser)
    add_vertical(parser)
    add_near(parser)
    common.add_self_calibration(parser)
    parser.add_argument(
        "--save", metavar="OUT", help="write the instrument file (YAML) with the A3 of --self-calibrate"
    )
    jobs.add_jobs(parser)
    parser.set_defaults(run=run)


@dataclass(frozen=True)
class Plan:
    """How to work on a night: the work on each frame, and solver and tilts, None if no frame can be read."""

    night: NightFolder
    work: Solving | Listing
    solver: Solver | None = None
    tilts: TiltLog | None = None


def run(args: argparse.Namespace) -> int:
    common.check_self_calibration(args)
    if args.save is not None and not args.self_calibrate:
        raise InstrumentError("--save writes what --self-calibrate finds: give both")
    common.check_frames(args)
    if args.pointings is not None:
        from starpos.cli import solve_pointings

        return solve_pointings.run(args)
    vertical, read, output = vertical_of(args), reader_of(args), Output(args, COLUMNS, HEAD)
    near_of(args)
    given = nights_of(frames_among(args.frames, args.tilt), args.tilt, common.has_own_level(args))
    if args.save is not None and len(given) > 1:
        raise InstrumentError("--save writes the A3 of one night: give one")
    nights = [night for night in given if isinstance(night, NightFolder)]
    statuses = [_refused(why, given) for why in given if not isinstance(why, NightFolder)]
    number = sum(len(night.frames) for night in nights)
    with jobs.workers_of(args, number) as workers:
        plans = []
        abouts = workers.map((Look(read), night.frames) for night in nights)
        for night, about in zip(nights, abouts, strict=True):
            try:
                plans.append(_plan(args, night, about, read))
            except TiltError as error:
                statuses.append(_refused(error, given))
        calls = ((plan.work, path) for plan in plans for path in plan.night.frames)
        # the lines of a turn wait for its end, and show no progress
        answers = jobs.watched(
            workers.map(calls), sum(len(p.night.frames) for p in plans), silent=not args.self_calibrate
        )
        for plan in plans:
            # takes the answers of this night, and leaves the others
            rows: Iterable = zip(plan.night.frames, answers, strict=False)
            if args.self_calibrate:
                rows = _turned(args, plan, list(rows))
            instrument = None if plan.solver is None else plan.solver.instrument
            fits = None if instrument is None else partial(say_what_would_fit, "solve", read, instrument)
            known = None if args.self_calibrate else instrument
            statuses.append(tell(args, output, plan.night, rows, vertical, known, fits))
    return max(statuses)


def _refused(why: StarposError, given: list) -> int:
    """Complain about a night that cannot be worked on; raises the error if it is the only night."""
    if len(given) == 1:
        raise why
    common.complain("solve", why)
    return common.UNREADABLE


def _plan(args: argparse.Namespace, night: NightFolder, about: About | None, read: Reader) -> Plan:
    # without a frame that can be read, each one reports why it cannot
    if about is None:
        return Plan(night, Listing(read))
    instrument, air = common.instrument_of(args, about), common.atmosphere_of(args)
    noise = instrument.inclinometer.noise_rad
    table = None if night.tilt is None else checked_tilts("solve", night.tilt, noise)
    jobs.prepare("solve", instrument, about)
    solver = Solver(instrument, catalogue.load_catalogue(), air, progress=common.ProgressBar())
    return Plan(
        night,
        Listing(read) if args.self_calibrate else Solving(read, instrument, air, night.tilt),
        solver,
        table,
    )


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
            common.complain("solve", answer.message)
        output.put(
            {"file": path} | json_of(answer.fix, vertical) | json_about(answer),
            line_of(path, answer, args.self_calibrate),
        )
    if lost and not solved and fits is not None:
        fits(lost)
    common.tell_extrapolation("solve", solved)
    together = _combine(night, solved)
    if solved:
        last, near = solved[-1].fix, near_of(args)
        whole = last if together is None else together
        tell_unknown("solve", args, vertical.at(last.latitude, last.longitude))
        if instrument is not None and (unknown := unknown_a3(instrument.calibration, whole.covariance)):
            _say(night, unknown)
        _tell_doubts(night, instrument, solved, whole, near)
        about = {} if near is None else {"km_from_near": near.km_from(whole.latitude, whole.longitude)}
        put_combined(output, night, together, solved, warnings, vertical, about)
    return common.UNREADABLE if unreadable else 0 if together else NO_FIX


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


def _turned(args: argparse.Namespace, plan: Plan, rows: list) -> Iterator:
    """(path, Solution or FrameError) of frames (path, Stars or FrameError), solved with the A3 that all of them tell."""
    frames = [stars for _, stars in rows if isinstance(stars, Stars)]
    answers: Iterator[Solution] = iter(())
    if frames and plan.solver is not None and plan.tilts is not None:
        answers = iter(solved_by_turning(args, plan.night, plan.solver, plan.tilts, frames))
    for path, item in rows:
        yield path, next(answers) if isinstance(item, Stars) else item


def solved_by_turning(
    args: argparse.Namespace,
    night: NightFolder,
    solver: Solver,
    tilts: TiltLog,
    frames: Sequence[Stars | Pointing],
) -> Sequence[Solution]:
    """Find A3 and the solutions of a night's frames, and write A3 as --save asks."""
    try:
        turned = turn(solver, frames, tilts.average, common.turn_of(args), solver.progress)
    except FixError as e:
        return [Solution.failed(stars, Status.POOR_FIT, str(e)) for stars in frames]
    error = f"the plumb line in the camera is known to {turned.plumb_stddev_arcsec:.2f} arcsec"
    if turned.plumb_stddev_arcsec > WORTH_SAVING_ARCSEC:
        kept = "" if args.save is None else f" {args.save} is not written:"
        _say(night, f"not calibrated:{kept} the headings hardly tell A3, {error}: turn it further")
        return turned.solutions
    if args.save is not None:
        instrument_file.write(Path(args.save), turned.instrument, f"A3 by turning on the spot: {error}")
    kept = "--save OUT keeps A3 and its errors" if args.save is None else f"{args.save} is written"
    _say(night, f"calibrated: {error}; {kept}")
    return turned.solutions


def _say(night: NightFolder, text: StarposError | str) -> None:
    """Print a line about a whole night on standard error."""
    common.complain("solve", text if night.folder is None else f"{night.folder}: {text}")


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

# SPDX-License-Identifier: Apache-2.0
"""`starpos solve`: position and heading from frames with their tilts, for each frame and for all together."""

import argparse
from collections.abc import Iterable
from dataclasses import dataclass
from functools import partial

from starpos.cli import console, jobs, options, overwriting, solve_pointings
from starpos.cli.archive import NightFolder, frames_among, nights_of
from starpos.cli.deflection import add_vertical, vertical_of
from starpos.cli.doubts import add_near, checked_tilts, near_of
from starpos.cli.fix_output import (
    COLUMNS,
    CSV_HELP,
    HEAD,
    JSON_HELP,
)
from starpos.cli.frame_work import About, Listing, Look, Reader, Solving, reader_of
from starpos.cli.output import Output, add_formats
from starpos.cli.overwriting import Written
from starpos.cli.solved_night import check_save, solved_by_turning, tell
from starpos.cli.what_fits import say_what_would_fit
from starpos.errors import InstrumentError, StarposError, TiltError
from starpos.fix.solver import Solver
from starpos.frames.stars import Stars
from starpos.instrument import instrument_update
from starpos.instrument.axis import with_frame_size
from starpos.instrument.tilt_log import TiltLog
from starpos.sky import catalogue


def define(parser: argparse.ArgumentParser) -> None:
    options.add_frames(parser, pointings=True)
    add_formats(parser, JSON_HELP, CSV_HELP)
    parser.add_argument(
        "--tilt",
        metavar="CSV",
        help="utc_unix_s, theta_x_deg, theta_y_deg[, theta_z_deg, temperature_c, sigma_deg]; not with nights: folders of "
        "frames with tilt.csv, nor with the instrument file of a camera fixed to the ground",
    )
    options.add_stamps(parser)
    options.add_instrument(parser)
    options.add_air(parser)
    add_vertical(parser)
    add_near(parser)
    options.add_self_calibration(parser)
    parser.add_argument(
        "--save",
        metavar="OUT",
        help="write the A3 of --self-calibrate into an instrument file (YAML); one that is there keeps its other keys; "
        "exit status 1 if the headings hardly tell A3, and nothing is written",
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
    options.check_self_calibration(args)
    if args.save is not None and not args.self_calibrate:
        raise InstrumentError("--save writes what --self-calibrate finds: give both")
    options.check_frames(args)
    if args.save is not None:
        overwriting.check(args, Written("--save", args.save, instrument_update.check_replaceable))
    if args.pointings is not None:
        return solve_pointings.run(args)
    vertical, read, output = vertical_of(args), reader_of(args), Output(args, COLUMNS, HEAD)
    near_of(args)
    given = nights_of(frames_among(args.frames, args.tilt), args.tilt, options.has_own_level(args))
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
                rows, saving = _turned(args, plan, list(rows))
                statuses.append(saving)
            instrument = None if plan.solver is None else plan.solver.instrument
            fits = None if instrument is None else partial(say_what_would_fit, "solve", read, instrument)
            known = None if args.self_calibrate else instrument
            statuses.append(tell(args, output, plan.night, rows, vertical, known, fits))
    return max(statuses)


def _refused(why: StarposError, given: list) -> int:
    """Complain about a night that cannot be worked on; raises the error if it is the only night."""
    if len(given) == 1:
        raise why
    console.complain("solve", why)
    return console.UNREADABLE


def _plan(args: argparse.Namespace, night: NightFolder, about: About | None, read: Reader) -> Plan:
    # without a frame that can be read, each one reports why it cannot
    if about is None:
        return Plan(night, Listing(read))
    instrument, air = options.instrument_of(args, about), options.atmosphere_of(args)
    instrument, doubt = with_frame_size(instrument, about)
    if doubt:
        console.complain("solve", doubt)
    check_save(args, instrument)
    noise = instrument.inclinometer.noise_rad
    table = None if night.tilt is None else checked_tilts("solve", night.tilt, noise)
    jobs.prepare("solve", instrument, about)
    solver = Solver(instrument, catalogue.load_catalogue(), air, progress=console.ProgressBar())
    return Plan(
        night,
        Listing(read) if args.self_calibrate else Solving(read, instrument, air, night.tilt),
        solver,
        table,
    )


def _turned(args: argparse.Namespace, plan: Plan, rows: list) -> tuple[list, int]:
    """(path, Solution or FrameError) of frames (path, Stars or FrameError), solved with the A3 that all of them tell.

    Returns the exit status of saving that A3 too.
    """
    frames = [stars for _, stars in rows if isinstance(stars, Stars)]
    if not frames or plan.solver is None or plan.tilts is None:
        return rows, 0
    solved, saving = solved_by_turning(args, plan.night, plan.solver, plan.tilts, frames)
    answers = iter(solved)
    return [(path, next(answers) if isinstance(item, Stars) else item) for path, item in rows], saving

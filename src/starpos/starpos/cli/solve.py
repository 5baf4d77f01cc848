# SPDX-License-Identifier: Apache-2.0
"""`starpos solve`: position and heading from frames with their tilts, for each frame and for all together."""

import argparse
import os
from collections.abc import Iterable
from dataclasses import replace

from starpos.cli import (
    console,
    heading_output,
    jobs,
    options,
    overwriting,
    solve_gnss,
    solve_pointings,
)
from starpos.cli.archive import NightFolder, frames_among, nights_of
from starpos.cli.fix_output import COLUMNS, CSV_HELP, HEAD, JSON_HELP
from starpos.cli.inputs import add_near, checked_tilts, given_of, is_untold, near_of, reader_of
from starpos.cli.output import Output, add_formats
from starpos.cli.overwriting import Written
from starpos.cli.plan import Plan
from starpos.cli.site import add_site, place_of
from starpos.cli.solved_night import check_save, say, tell, tell_turned
from starpos.cli.vertical import add_vertical, vertical_of
from starpos.earth.known_place import KnownPlace
from starpos.errors import FrameError, InstrumentError, StarposError, TiltError
from starpos.fix.solver import Solver
from starpos.instrument import instrument_update
from starpos.instrument.axis import with_frame_size
from starpos.instrument.tilts import NO_TILTS
from starpos.night.hints import of_one_camera
from starpos.night.reading import About, First, Given, Reader, stars_of
from starpos.night.together import turned
from starpos.night.work import Fitting, Identifying, OnFile, Solving
from starpos.report import field
from starpos.sky import catalogue


def define(parser: argparse.ArgumentParser) -> None:
    options.add_frames(parser, pointings=True)
    add_formats(parser, JSON_HELP, CSV_HELP)
    parser.add_argument(
        "--tilt",
        metavar="CSV",
        help="utc_unix_s, theta_x_deg, theta_y_deg[, theta_z_deg, temperature_c, sigma_deg]; not with nights: folders of "
        "frames with tilt.csv, nor with the instrument file of a camera fixed to the ground; --site needs none",
    )
    solve_gnss.add_gnss(parser)
    options.add_stamps(parser)
    options.add_instrument(parser)
    options.add_air(parser)
    add_vertical(parser)
    add_site(parser)
    add_near(parser)
    options.add_self_calibration(parser)
    parser.add_argument(
        "--save",
        metavar="OUT",
        help="write the A3 of --self-calibrate into an instrument file (YAML); one that is there keeps its other keys; "
        "exits with status 1 and writes nothing if the headings do not determine A3",
    )
    jobs.add_jobs(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    if len(args.frames) == 1 and field.is_field(args.frames[0]):
        return _of_field(args)
    return _run(args)


def _of_field(args: argparse.Namespace) -> int:
    """Solve a field report, with its instrument and its air where the options name none."""
    if args.tilt is not None:
        raise TiltError(f"{args.frames[0]} has its own tilts: leave --tilt out")
    with field.opened(args.frames[0]) as (folder, air):
        args.frames = [str(folder)]
        if is_untold(args):
            args.instrument = str(folder / field.INSTRUMENT)
        if (args.pressure_hpa, args.temperature_c, args.humidity, args.wavelength_um) == (None,) * 4:
            args.air = air
        return _run(args)


def _run(args: argparse.Namespace) -> int:
    options.check_self_calibration(args)
    if args.save is not None and not args.self_calibrate:
        raise InstrumentError("--save writes what --self-calibrate finds: give both")
    options.check_frames(args)
    solve_gnss.check(args)
    if args.save is not None:
        overwriting.check(args, Written("--save", args.save, instrument_update.check_replaceable))
    if args.pointings is not None:
        return solve_pointings.run(args)
    vertical, read = vertical_of(args), reader_of(args)
    place = place_of(args, vertical)
    output = Output(
        args, *((COLUMNS, HEAD) if place is None else (heading_output.COLUMNS, heading_output.HEAD))
    )
    near_of(args)
    own_level = options.has_own_level(args)
    receiver = solve_gnss.read_receiver(args.gnss, args.learned, "solve")
    # the folder of a night has its tilts
    needs_no_tilt = own_level or (
        (place is not None or receiver is not None) and not any(map(os.path.isdir, args.frames))
    )
    given = nights_of(frames_among(args.frames, args.tilt, args.gnss), args.tilt, needs_no_tilt)
    if args.save is not None and len(given) > 1:
        raise InstrumentError("--save writes the A3 of one night: give one")
    nights = [night for night in given if isinstance(night, NightFolder)]
    statuses = [_refused(why, given) for why in given if not isinstance(why, NightFolder)]
    number = sum(len(night.frames) for night in nights)
    with jobs.workers_of(args, number) as workers:
        plans = []
        abouts = workers.map((First(read), night.frames) for night in nights)
        for night, about in zip(nights, abouts, strict=True):
            try:
                plans.append(_plan(args, night, about, read, own_level, place))
            except TiltError as error:
                statuses.append(_refused(error, given))
        calls = ((plan.work, path) for plan in plans for path in plan.night.frames)
        # the lines of a turn come at its end, and show no progress
        answers = jobs.watched(
            workers.map(calls),
            sum(len(p.night.frames) for p in plans),
            silent=not (args.self_calibrate or args.gnss),
        )
        for plan in plans:
            # takes the answers of this night, and leaves the rest
            rows: Iterable = zip(plan.night.frames, answers, strict=False)
            if receiver is not None:
                statuses.append(solve_gnss.run(args, output, plan, list(rows), receiver, vertical))
                continue
            if args.self_calibrate:
                rows, saving = _turned(args, plan, list(rows))
                statuses.append(saving)
            known = None if args.self_calibrate else plan.given.instrument
            status, lost = tell(args, output, plan.night, rows, vertical, known, place)
            statuses.append(status)
            if lost:
                say(plan.night, *Fitting(plan.given)(read(lost)))
    return max(statuses)


def _refused(why: StarposError, given: list) -> int:
    """Complain about a night that cannot be worked on; raises the error if it is the only night."""
    if len(given) == 1:
        raise why
    console.complain("solve", why)
    return console.UNREADABLE


def _plan(
    args: argparse.Namespace,
    night: NightFolder,
    about: About | None,
    read: Reader,
    own_level: bool,
    place: KnownPlace | None,
) -> Plan:
    # without a frame that can be read, each one reports why it cannot
    if about is None:
        return Plan(night, OnFile(read, stars_of), Given(None))
    instrument, doubt = with_frame_size(options.instrument_of(args, about), about)
    if doubt:
        console.complain("solve", doubt)
    given, air = replace(given_of(args, about), instrument=instrument), options.atmosphere_of(args)
    check_save(args, instrument)
    tilts = NO_TILTS if night.tilt is None else checked_tilts("solve", night.tilt, instrument)
    jobs.prepare("solve", instrument, about)
    solver = Solver(instrument, catalogue.load_catalogue(), air, progress=console.ProgressBar())
    levelled = own_level or night.tilt is not None
    solving = Solving(given, air, tilts if levelled else None, place)
    together = args.self_calibrate or args.gnss is not None
    work = Identifying(given) if together else solving
    return Plan(night, OnFile(read, work), given, solver, tilts)


def _turned(args: argparse.Namespace, plan: Plan, rows: list) -> tuple[list, int]:
    """(path, Solution or FrameError) of frames (path, Identifying's answer or FrameError), with their A3.

    Returns the exit status of saving that A3 too.
    """
    sights = [answer[0] for _, answer in rows if not isinstance(answer, FrameError)]
    if not sights or plan.solver is None:
        return rows, 0
    solver, seen = of_one_camera(plan.solver, sights)
    found = turned(solver, seen, plan.tilts, options.turn_of(args))
    solutions = iter(found.solutions)
    answers = [(path, answer if isinstance(answer, FrameError) else next(solutions)) for path, answer in rows]
    return answers, tell_turned(args, plan.night, found)

# SPDX-License-Identifier: Apache-2.0
"""`starpos solve`: position and heading from frames with their tilts, for each frame and for all together."""

import argparse
import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from starpos.averaging.altitudes import FoundAxis
from starpos.cli import console, fix_output, inputs, options, overwriting
from starpos.cli.console import Output, add_formats
from starpos.cli.fix_output import (
    COLUMNS,
    CSV_HELP,
    FIX_KEYS,
    HEAD,
    JSON_HELP,
    json_about,
    json_of,
    json_on_ground,
    line_of,
    put_combined,
    with_heading,
)
from starpos.cli.inputs import (
    NightFolder,
    add_near,
    checked_tilts,
    frames_among,
    given_of,
    is_untold,
    near_of,
    nights_of,
    reader_of,
)
from starpos.cli.options import add_site, add_vertical, place_of, tell_unknown, vertical_of
from starpos.cli.overwriting import Written, save_instrument
from starpos.earth.place import Place
from starpos.earth.vertical import Vertical
from starpos.errors import FrameError, InstrumentError, StarposError, TiltError
from starpos.fix.searching import of_one_camera
from starpos.fix.solution import Solution, Status, status_of
from starpos.fix.solver import Solver
from starpos.frames.tables import Pointing, read_pointings
from starpos.gnss import states
from starpos.gnss.receiver import read_gnss_csv
from starpos.gnss.solving import Watched
from starpos.gnss.states import Learned
from starpos.gnss.watch import GnssCheck
from starpos.instrument import instrument_file
from starpos.instrument.instrument import Instrument, with_frame_size
from starpos.instrument.tilt_log import NO_TILTS, Tilts
from starpos.night.reading import NO_CAMERA, About, First, Given, Reader, stars_of
from starpos.night.remarks import WORTH_SAVING_ARCSEC, Near, of_inclinometer
from starpos.night.together import (
    Receiver,
    Solved,
    TurnedNight,
    from_elevations,
    together,
    turned,
    watched_night,
)
from starpos.night.work import Fitting, Identifying, OnFile, Solving
from starpos.report import field
from starpos.sky import catalogue
from starpos.units import utc_text


@dataclass(frozen=True)
class Plan:
    """How to solve a night: the work on each frame, the instruments, and the solver of its first frame.

    solver: None if no frame can be read; then each one reports why.
    """

    night: NightFolder
    work: OnFile
    given: Given
    solver: Solver | None = None
    tilts: Tilts = NO_TILTS


NO_FIX = 1


def tell(
    args: argparse.Namespace,
    output: Output,
    night: NightFolder,
    rows: Iterable,
    vertical: Vertical,
    given: Instrument | None = None,
    place: Place | None = None,
) -> tuple[int, str]:
    """Write (path, Solution or FrameError) of each frame, and their common result.

    given: the instrument whose A3 was used unchanged; None if A3 was found by turning.
    place: the known place, whose headings are then reported; None without one.
    Returns the exit status, and a frame that was not identified if no frame has a fix, else ''.
    """
    solved: list[Solved] = []
    headings: list[Solution] = []
    warnings: set[str] = set()
    unreadable, lost = False, ""
    for path, answer in rows:
        if isinstance(answer, FrameError):
            unreadable = True
            answer = Solution.unreadable(path, answer)
        warnings |= set(answer.warnings)
        if answer.status is Status.NOT_IDENTIFIED:
            lost = lost or path
        if answer.fix:
            solved.append(Solved.of(answer, answer.fix))
        elif answer.at_place is None or not answer.ok:
            console.complain("solve", answer.message)
        if answer.remark:
            console.complain("solve", answer.remark)
        values = {"file": path} | json_of(answer.fix, vertical) | json_about(answer)
        if place is None:
            output.put(values, line_of(path, answer, args.self_calibrate))
            continue
        headings += [answer] if answer.at_place else []
        told = fix_output.with_heading(values, answer.at_place, place)
        output.put(told, fix_output.heading_line_of(path, answer))
    near = near_of(args)
    whole = together(solved, given, near)
    mean, why = fix_output.mean_of(headings)
    say(night, *([whole.why_not] if whole.why_not else ()), *whole.remarks, *why)
    if solved:
        last = solved[-1].fix
        tell_unknown("solve", args, vertical.at(last.latitude, last.longitude))
        where = last if whole.average is None else whole.average
        about = {} if near is None else {"km_from_near": near.km_from(where.latitude, where.longitude)}
        if place is not None:
            about |= fix_output.with_heading(json_of(whole.average, vertical), mean, place)
        put_combined(output, night, whole.average, solved, warnings, vertical, about)
    elif headings and place is not None:
        fix_output.put_mean(output, night, headings, mean, place, vertical)
    found = headings if place is not None and not args.tilt else whole.average
    status = console.UNREADABLE if unreadable else 0 if found else NO_FIX
    return status, "" if solved or headings else lost


def check_save(args: argparse.Namespace, instrument: Instrument) -> None:
    """Raise InstrumentError if the file of --save exists and describes another instrument."""
    if args.save is not None:
        instrument_file.check_fits(Path(args.save), instrument)


def tell_turned(args: argparse.Namespace, night: NightFolder, turned: TurnedNight) -> int:
    """Say what was found by turning, and write A3 as --save asks; NO_FIX if it is asked for and not written."""
    if turned.calibrated is None or not turned.worth_saving:
        say(night, *turned.remarks, *([] if args.save is None else [f"{args.save} is not written"]))
        return 0 if args.save is None else NO_FIX
    if args.save is not None:
        about = f"A3 by turning on the spot, {turned.remarks[0]}"
        save_instrument("solve", args.save, turned.calibrated.instrument, about)
    kept = "--save OUT keeps A3 and its errors" if args.save is None else f"{args.save} is written"
    say(night, *turned.remarks, kept)
    return 0


def say(night: NightFolder, *texts: object) -> None:
    """Print lines about a whole night on standard error."""
    for text in texts:
        console.complain("solve", text if night.folder is None else f"{night.folder}: {text}")


_GNSS_NO_FIX = 1


def add_gnss(parser: argparse.ArgumentParser) -> None:
    """Add the options that `check`, `read_receiver` and `run` take."""
    parser.add_argument(
        "--gnss",
        metavar="CSV",
        help="fixes of a GNSS receiver: utc_unix_s, latitude, longitude (deg, WGS 84), altitude_m, sigma_east_m, "
        "sigma_north_m, status; they teach A3, the inclinometer's errors and the deflection while the stars agree with "
        "them, and never enter the place of their own frame",
    )
    parser.add_argument(
        "--learned",
        metavar="FILE",
        help="what --gnss taught: read at the beginning if the file is there, written at the end",
    )


def check_gnss(args: argparse.Namespace) -> None:
    """Raise InstrumentError if options do not go together."""
    if args.gnss is None:
        if args.learned is not None:
            raise InstrumentError("--learned keeps what --gnss teaches: give both")
        return
    if args.self_calibrate or args.pointings is not None:
        other = "--pointings" if args.pointings is not None else "--self-calibrate"
        raise InstrumentError(f"--gnss and {other} do not go together: give one of the two")
    if args.site is not None:
        raise InstrumentError("--gnss and --site both say where the instrument is: give one of the two")


def read_receiver(gnss: str | None, learned: str | None, command: str) -> Receiver | None:
    """Read the tables of --gnss and --learned; None without the first.  Raises StarposError."""
    if gnss is None:
        return None
    track, faults = read_gnss_csv(gnss)
    for fault in faults:
        console.complain(command, fault)
    before = None if learned is None else states.read_learned(Path(learned))
    return Receiver(track, before)


def run_gnss(
    args: argparse.Namespace,
    output: Output,
    plan: Plan,
    rows: list,
    receiver: Receiver,
    vertical: Vertical,
) -> int:
    """Write the answers to (path, Identifying's answer or FrameError) of a night's frames; returns the exit status."""
    sights = [answer[0] for _, answer in rows if not isinstance(answer, FrameError)]
    answers: list[Watched] = []
    if sights and plan.solver is not None:
        solver, seen = of_one_camera(plan.solver, sights)
        if solver.instrument.vertical is not None:
            raise InstrumentError(
                "--gnss teaches an inclinometer, and this camera is its own level: leave --gnss out"
            )
        tilts = None if plan.night.tilt is None else plan.tilts
        night = watched_night(solver, seen, tilts, receiver, vertical)
        answers = list(night.answers)
        for remark in night.remarks:
            console.complain("solve", remark)
        if args.learned is not None:
            _save_learned(Path(args.learned), night.learned)
    solved, warnings, unreadable = [], set(), False
    following = iter(answers)
    for path, answer in rows:
        if isinstance(answer, FrameError):
            unreadable = True
            told = Watched(solution=Solution.unreadable(path, answer))
        else:
            told = next(following)
            # the frame was identified before this solver had its focal length: the remark is of that moment
            if remark := answer[0].solution.remark:
                console.complain("solve", remark)
                told = replace(told, solution=replace(told.solution, remark=remark))
        warnings |= set(told.solution.warnings)
        if told.solution.fix:
            solved.append(Solved.of(told.solution, told.solution.fix))
        elif told.solution.at_place is None or not told.solution.ok:
            console.complain("solve", told.solution.message)
        output.put(
            {"file": path} | json_of_watched(told) | json_about(told.solution), _line_of_watched(path, told)
        )
    whole = together(solved, None, near_of(args))
    unnamed = of_inclinometer(plan.solver.instrument) if solved and plan.solver is not None else ()
    for text in (*([whole.why_not] if whole.why_not else ()), *unnamed, *whole.remarks):
        console.complain("solve", text)
    if solved:
        put_combined(output, plan.night, whole.average, solved, warnings, vertical)
    # without tilts headings are all that was asked for
    found = whole.average or (args.tilt is None and any(told.solution.at_place for told in answers))
    return console.UNREADABLE if unreadable else 0 if found else _GNSS_NO_FIX


def _save_learned(path: Path, learned: Learned | None) -> None:
    if learned is None or not learned.frames:
        console.complain("solve", f"{path} is not written: no frame with a GNSS place has taught anything")
    else:
        states.save_learned(path, learned)


def json_of_watched(told: Watched) -> dict:
    """The keys of --json of a frame that come from its fix, or its heading at GNSS's place, and `gnss`."""
    fix, ground = told.solution.fix, told.ground
    keys = dict.fromkeys(FIX_KEYS) if fix is None or ground is None else json_on_ground(fix, ground)
    if (at_place := told.solution.at_place) is not None:
        keys = with_heading(keys, at_place, at_place.place)
    return keys | {"gnss": None if told.compared is None else json_of_check(told.compared.check)}


def json_of_check(check: GnssCheck) -> dict:
    """The key `gnss` of --json."""
    return {
        "status": check.status.value,
        "distance_m": check.distance_m,
        "bearing_deg": check.bearing_deg,
        "sigma_m": check.sigma_m,
    }


def _line_of_watched(path: str, told: Watched) -> str:
    if told.solution.at_place is None:
        line = line_of(path, told.solution, False)
    else:
        line = fix_output.heading_line_of(path, told.solution)
    if told.compared is None:
        return line
    check = told.compared.check
    return f"{line}; GNSS {check.status}: {check.sentence}"


# the status of a row that gives an elevation
ELEVATION = "elevation alone"
ELEVATIONS_HEAD = "row: the zenith distance of its direction; together these give the position"


def run_pointings(args: argparse.Namespace) -> int:
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
        saving = _save_axis(args, solver, found.axis)
    say(night, *([whole.why_not] if whole.why_not else ()), *whole.remarks)
    place, about = whole.average, {}
    if place is not None:
        tell_unknown("solve", args, vertical.at(place.latitude, place.longitude))
        about = {} if near is None else {"km_from_near": near.km_from(place.latitude, place.longitude)}
    if place is not None or whole.why_not:
        put_combined(output, night, place, [], set(), vertical, about)
    return max(saving, 0 if place else NO_FIX)


def _save_axis(args: argparse.Namespace, solver: Solver, axis: FoundAxis | None) -> int:
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


def define(parser: argparse.ArgumentParser) -> None:
    options.add_frames(parser, pointings=True)
    add_formats(parser, JSON_HELP, CSV_HELP)
    parser.add_argument(
        "--tilt",
        metavar="CSV",
        help="utc_unix_s, theta_x_deg, theta_y_deg[, theta_z_deg, temperature_c, sigma_deg]; not with nights: folders of "
        "frames with tilt.csv, nor with the instrument file of a camera fixed to the ground; --site needs none",
    )
    add_gnss(parser)
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
    inputs.add_jobs(parser)
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
    check_gnss(args)
    if args.save is not None:
        overwriting.check(args, Written("--save", args.save, instrument_file.check_replaceable))
    if args.pointings is not None:
        return run_pointings(args)
    vertical, read = vertical_of(args), reader_of(args)
    place = place_of(args, vertical)
    output = Output(
        args, *((COLUMNS, HEAD) if place is None else (fix_output.HEADING_COLUMNS, fix_output.HEADING_HEAD))
    )
    near_of(args)
    own_level = options.has_own_level(args)
    receiver = read_receiver(args.gnss, args.learned, "solve")
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
    with inputs.workers_of(args, number) as workers:
        plans = []
        abouts = workers.map((First(read), night.frames) for night in nights)
        for night, about in zip(nights, abouts, strict=True):
            try:
                plans.append(_plan(args, night, about, read, own_level, place))
            except TiltError as error:
                statuses.append(_refused(error, given))
        calls = ((plan.work, path) for plan in plans for path in plan.night.frames)
        # the lines of a turn come at its end, and show no progress
        answers = inputs.watched(
            workers.map(calls),
            sum(len(p.night.frames) for p in plans),
            silent=not (args.self_calibrate or args.gnss),
        )
        for plan in plans:
            # takes the answers of this night, and leaves the rest
            rows: Iterable = zip(plan.night.frames, answers, strict=False)
            if receiver is not None:
                statuses.append(run_gnss(args, output, plan, list(rows), receiver, vertical))
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
    place: Place | None,
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
    inputs.prepare("solve", instrument, about)
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

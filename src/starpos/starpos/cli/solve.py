# SPDX-License-Identifier: Apache-2.0
"""`starpos solve`: position and heading from frames with their tilts, for each frame and for all together."""

import argparse
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from starpos.averaging.average import Average, average
from starpos.calibration.turning import turn
from starpos.calibration.unknown import unknown_a3
from starpos.cli import common, jobs
from starpos.cli.archive import NightFolder, nights_of
from starpos.cli.deflection import add_vertical, tell_unknown, vertical_of
from starpos.cli.frame_work import About, Listing, Look, Reader, Solving, reader_of, tilts
from starpos.cli.what_fits import say_what_would_fit
from starpos.earth.orientation import measured_until, table_age_days
from starpos.earth.vertical import Vertical, geodetic
from starpos.errors import FixError, FrameError, InstrumentError, StarposError, TiltError
from starpos.fix.fix import Fix
from starpos.fix.solver import Solution, Solver, Status
from starpos.frames.pointings import Pointing
from starpos.frames.stars import Stars
from starpos.instrument import instrument_file
from starpos.instrument.instrument import Calibration
from starpos.instrument.tilt_log import TiltLog
from starpos.sky import catalogue
from starpos.utc import utc_text

NO_FIX = 1
WORTH_SAVING_ARCSEC = 600.0
# numbers of an average that are printed
COUNTS = ("frames", "poses", "left_out", "moved")


def define(parser: argparse.ArgumentParser) -> None:
    common.add_frames(parser, pointings=True)
    parser.add_argument(
        "--near",
        type=float,
        nargs=2,
        metavar=("LAT", "LON"),
        help="pointings without a roll: which of two places it is, where their elevations leave two, deg",
    )
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


@dataclass(frozen=True)
class Solved:
    """The part of a Solution that is needed until the end of a night."""

    fix: Fix
    extrapolated_days: float
    stars_detected: int
    stars_matched: int
    log_odds: float

    @classmethod
    def of(cls, s: Solution, fix: Fix) -> "Solved":
        """The part of a solution with a fix."""
        light = replace(fix, used=np.zeros(0, int), residual_px=np.zeros((0, 2)))
        log_odds = s.attitude.log_odds if s.attitude else float("nan")
        return cls(light, s.extrapolated_days, s.stars_detected, len(s.names), log_odds)


def run(args: argparse.Namespace) -> int:
    common.check_self_calibration(args)
    if args.save is not None and not args.self_calibrate:
        raise InstrumentError("--save writes what --self-calibrate finds: give both")
    common.check_frames(args)
    if args.pointings is not None:
        from starpos.cli import solve_pointings

        return solve_pointings.run(args)
    if args.near is not None:
        raise InstrumentError("--near is for --pointings without a roll: leave it out")
    vertical, read = vertical_of(args), reader_of(args)
    given = nights_of(args.frames, args.tilt, common.has_own_level(args))
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
        answers = jobs.watched(workers.map(calls), sum(len(plan.night.frames) for plan in plans))
        for plan in plans:
            # takes the answers of this night, and leaves the others
            rows: Iterable = zip(plan.night.frames, answers, strict=False)
            if args.self_calibrate:
                rows = _turned(args, plan, list(rows))
            known = None if plan.solver is None or args.self_calibrate else plan.solver.instrument.calibration
            fits = (
                None
                if plan.solver is None
                else partial(say_what_would_fit, "solve", read, plan.solver.instrument)
            )
            statuses.append(tell(args, plan.night, rows, vertical, known, fits))
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
    table = None if night.tilt is None else tilts(night.tilt, instrument.inclinometer.noise_rad)
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
    night: NightFolder,
    rows: Iterable,
    vertical: Vertical,
    calibration: Calibration | None = None,
    fits: Callable[[str], None] | None = None,
) -> int:
    """Print (path, Solution or FrameError) of each frame, and their average; returns the exit status.

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
        if args.json:
            common.print_json({"file": path} | json_of(answer.fix, vertical) | json_about(answer))
        else:
            print(line_of(path, answer, args.self_calibrate), flush=True)
    if lost and not solved and fits is not None:
        fits(lost)
    common.tell_extrapolation("solve", solved)
    together = _combine(night, solved)
    if solved:
        last = solved[-1].fix
        tell_unknown("solve", args, vertical.at(last.latitude, last.longitude))
        if calibration is not None:
            wide = last if together is None else together
            if unknown := unknown_a3(calibration, wide.covariance):
                _say(night, unknown)
        print_combined(night, together, solved, warnings, args, vertical)
    return common.UNREADABLE if unreadable else 0 if together else NO_FIX


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


def json_of(fix: Fix | Average | None, vertical: Vertical) -> dict:
    """The keys of --json that come from a fix; None for each if there is none."""
    keys = ("utc", "latitude", "longitude", "heading", "latitude_geodetic", "longitude_geodetic", "sigma_east_m",
            "sigma_north_m", "sigma_heading_deg", "covariance", "covariance_geodetic", "xi_arcsec", "eta_arcsec",
            "deflection_stddev_arcsec", "budget")  # fmt: skip
    if fix is None:
        return dict.fromkeys(keys)
    ground = geodetic(fix.latitude, fix.longitude, fix.heading, fix.covariance, vertical)
    covariance = in_degrees(fix.covariance)
    sigma = np.sqrt(np.diag(covariance))
    values = (
        utc_text(fix.utc_unix_s),
        np.degrees(fix.latitude),
        np.degrees(fix.longitude),
        np.degrees(fix.heading),
        np.degrees(ground.latitude),
        np.degrees(ground.longitude),
        *sigma,
        covariance,
        in_degrees(ground.covariance),
        ground.deflection.xi_arcsec,
        ground.deflection.eta_arcsec,
        ground.deflection.stddev_arcsec,
        budget_of(fix, vertical),
    )
    return dict(zip(keys, values, strict=True))


def in_degrees(covariance: np.ndarray) -> np.ndarray:
    """A covariance (3, 3) of east m, north m, heading rad with the heading in deg instead."""
    unit = np.array([1.0, 1.0, np.degrees(1.0)])
    return covariance * np.outer(unit, unit)


def budget_of(fix: Fix | Average, vertical: Vertical) -> dict:
    """1 sigma (3,) of each source: east m, north m, heading deg; the deflection acts on the geodetic place only."""
    terms = {t.name: np.sqrt(np.diag(t.covariance)[:3]) * [1, 1, np.degrees(1)] for t in fix.terms}
    ground = geodetic(fix.latitude, fix.longitude, 0.0, fix.covariance, vertical)
    terms["deflection (geodetic only)"] = np.sqrt(np.diag(ground.deflection_covariance)) * [
        1,
        1,
        np.degrees(1),
    ]
    return terms


def json_about(s: Solution) -> dict:
    """The keys of --json about the stars of a frame."""
    a = s.attitude
    return {
        "stars_detected": s.stars_detected,
        "stars_matched": len(s.names),
        "residual_arcsec": s.fix.residual_arcsec if s.fix else None,
        "log_odds": a.log_odds if a else None,
        "status": s.status.value,
        "warnings": list(s.warnings),
    }


def line_of(path: str, s: Solution, turning: bool) -> str:
    """The line of a frame; turning: its place waits for the other headings."""
    if s.fix is None:
        return f"{path}: {s.status.value}, {s.stars_detected} stars detected"
    # one frame of a turn does not tell A3, so its own place would be 1100 km wide
    where = "its place waits for the whole turn" if turning else place_text(s.fix)
    stars = f", {len(s.names)} of {s.stars_detected} stars" if s.stars_detected else ""
    return f"{path}: {where}{stars}"


def place_text(fix: Fix | Average) -> str:
    east, north, heading = np.sqrt(np.diag(in_degrees(fix.covariance)))
    facing = f"heading {np.degrees(fix.heading):.4f} +- {heading:.4f} deg"
    if np.isnan(fix.heading):
        facing = "heading not known: the camera was touched, or nobody knows its roll"
    return f"{np.degrees(fix.latitude):+.6f} {np.degrees(fix.longitude):+.6f} +- {north:.0f} m N {east:.0f} m E, {facing}"


def print_combined(
    night: NightFolder,
    all_together: Average | None,
    solved: list[Solved],
    warnings: set[str],
    args: argparse.Namespace,
    vertical: Vertical,
) -> None:
    name = {} if night.folder is None else {"night": night.folder}
    if args.json:
        about = {
            "stars_detected": sum(s.stars_detected for s in solved),
            "stars_matched": sum(s.stars_matched for s in solved),
            "residual_arcsec": np.sqrt(np.mean([s.fix.residual_arcsec**2 for s in solved] or [np.nan])),
            "log_odds": sum(s.log_odds for s in solved) if solved else None,
            "status": (Status.OK if all_together else Status.POOR_FIT).value,
            "warnings": sorted(warnings),
        }
        common.print_json(
            {"combined": True}
            | name
            | (
                dict.fromkeys(COUNTS)
                if all_together is None
                else {k: getattr(all_together, k) for k in COUNTS}
            )
            | json_of(all_together, vertical)
            | about
            | {"iers_table_age_days": table_age_days(all_together.utc_unix_s) if all_together else None}
        )
        return
    if all_together is None:
        return
    ground = geodetic(all_together.latitude, all_together.longitude, 0.0, all_together.covariance, vertical)
    turned = f" (the last of {all_together.poses} poses)" if all_together.poses > 1 else ""
    folder = "" if night.folder is None else f"{night.folder}: "
    print(f"{folder}{all_together.frames} frames together: {place_text(all_together)}{turned} (astronomic)")
    sigma = np.sqrt(np.diag(ground.covariance))
    print(
        f"geodetic, WGS 84: {np.degrees(ground.latitude):+.6f} {np.degrees(ground.longitude):+.6f} "
        f"+- {sigma[1]:.0f} m N {sigma[0]:.0f} m E (the deflection of the vertical included)"
    )
    for name, (east, north, heading) in budget_of(all_together, vertical).items():
        turn = "" if np.isnan(all_together.heading) else f" {heading * 3600:8.2f} arcsec"
        print(f"  {name:<28} {east:8.2f} m E {north:8.2f} m N{turn}")
    age_days = table_age_days(all_together.utc_unix_s)
    where = f"{age_days:.0f} days before" if age_days > 0 else "after"
    print(
        f"Earth rotation: IERS table, measured until {utc_text(measured_until())[:10]}, {where} these frames"
    )

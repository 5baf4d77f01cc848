# SPDX-License-Identifier: Apache-2.0
"""`starpos solve --gnss`: frames with a GNSS receiver, which teaches the instrument and is guarded."""

import argparse
from dataclasses import replace
from pathlib import Path

from starpos.cli import console, heading_output
from starpos.cli.fix_output import FIX_KEYS, json_about, json_on_ground, line_of, put_combined
from starpos.cli.heading_output import with_heading
from starpos.cli.inputs import near_of
from starpos.cli.output import Output
from starpos.cli.plan import Plan
from starpos.earth.vertical import Vertical
from starpos.errors import FrameError, InstrumentError
from starpos.fix.solution import Solution
from starpos.gnss import learned_file
from starpos.gnss.solving import Watched
from starpos.gnss.states import Learned
from starpos.gnss.table import read_gnss_csv
from starpos.gnss.watch import GnssCheck
from starpos.night.hints import of_one_camera
from starpos.night.remarks import of_inclinometer
from starpos.night.together import Solved, together
from starpos.night.watching import Receiver, watched_night

NO_FIX = 1


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


def check(args: argparse.Namespace) -> None:
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
    before = None if learned is None else learned_file.read_if_there(Path(learned))
    return Receiver(track, before)


def run(
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
            _save(Path(args.learned), night.learned)
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
        output.put({"file": path} | json_of_watched(told) | json_about(told.solution), _line(path, told))
    whole = together(solved, None, near_of(args))
    unnamed = of_inclinometer(plan.solver.instrument) if solved and plan.solver is not None else ()
    for text in (*([whole.why_not] if whole.why_not else ()), *unnamed, *whole.remarks):
        console.complain("solve", text)
    if solved:
        put_combined(output, plan.night, whole.average, solved, warnings, vertical)
    # without tilts headings are all that was asked for
    found = whole.average or (args.tilt is None and any(told.solution.at_place for told in answers))
    return console.UNREADABLE if unreadable else 0 if found else NO_FIX


def _save(path: Path, learned: Learned | None) -> None:
    if learned is None or not learned.frames:
        console.complain("solve", f"{path} is not written: no frame with a GNSS place has taught anything")
    else:
        learned_file.save(path, learned)


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


def _line(path: str, told: Watched) -> str:
    if told.solution.at_place is None:
        line = line_of(path, told.solution, False)
    else:
        line = heading_output.line_of(path, told.solution)
    if told.compared is None:
        return line
    check = told.compared.check
    return f"{line}; GNSS {check.status}: {check.sentence}"

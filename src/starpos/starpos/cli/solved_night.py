# SPDX-License-Identifier: Apache-2.0
"""Prints the result of a night: a line for each frame, A3 if it was found by turning, the place of all together."""

import argparse
from collections.abc import Iterable
from pathlib import Path

from starpos.cli import console, heading_output
from starpos.cli.archive import NightFolder
from starpos.cli.fix_output import json_about, json_of, line_of, put_combined
from starpos.cli.inputs import near_of
from starpos.cli.output import Output
from starpos.cli.overwriting import save_instrument
from starpos.cli.vertical import tell_unknown
from starpos.earth.known_place import KnownPlace
from starpos.earth.vertical import Vertical
from starpos.errors import FrameError
from starpos.fix.solution import Solution, Status
from starpos.instrument import instrument_update
from starpos.instrument.instrument import Instrument
from starpos.night.together import Solved, TurnedNight, together

NO_FIX = 1


def tell(
    args: argparse.Namespace,
    output: Output,
    night: NightFolder,
    rows: Iterable,
    vertical: Vertical,
    given: Instrument | None = None,
    place: KnownPlace | None = None,
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
        told = heading_output.with_heading(values, answer.at_place, place)
        output.put(told, heading_output.line_of(path, answer))
    near = near_of(args)
    whole = together(solved, given, near)
    mean, why = heading_output.mean_of(headings)
    say(night, *([whole.why_not] if whole.why_not else ()), *whole.remarks, *why)
    if solved:
        last = solved[-1].fix
        tell_unknown("solve", args, vertical.at(last.latitude, last.longitude))
        where = last if whole.average is None else whole.average
        about = {} if near is None else {"km_from_near": near.km_from(where.latitude, where.longitude)}
        if place is not None:
            about |= heading_output.with_heading(json_of(whole.average, vertical), mean, place)
        put_combined(output, night, whole.average, solved, warnings, vertical, about)
    elif headings and place is not None:
        heading_output.put_mean(output, night, headings, mean, place, vertical)
    found = headings if place is not None and not args.tilt else whole.average
    status = console.UNREADABLE if unreadable else 0 if found else NO_FIX
    return status, "" if solved or headings else lost


def check_save(args: argparse.Namespace, instrument: Instrument) -> None:
    """Raise InstrumentError if the file of --save exists and describes another instrument."""
    if args.save is not None:
        instrument_update.check_fits(Path(args.save), instrument)


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

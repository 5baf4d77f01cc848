# SPDX-License-Identifier: Apache-2.0
"""`starpos deflection`: the deflection of the vertical at a known site, from a zenith camera's frames and tilts."""

import argparse
import os
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from starpos.cli import bags, console, deflection_plan, jobs, options
from starpos.cli.archive import frames_among
from starpos.cli.deflection_output import (
    COLUMNS,
    HEAD,
    JSON_HELP,
    combined_json,
    combined_text,
    frame_json,
    frame_line,
)
from starpos.cli.inputs import checked_tilts, given_of, reader_of
from starpos.cli.output import Output, add_formats
from starpos.errors import FixError, FrameError, InstrumentError, TiltError
from starpos.fix.solution import Solution
from starpos.fix.solver import Solver
from starpos.instrument.axis import with_frame_size
from starpos.instrument.instrument import Instrument
from starpos.night.bag import each_frame, is_bag
from starpos.night.reading import First
from starpos.night.remarks import of_inclinometer
from starpos.night.sightings import DeflectionSession, ZenithSighted
from starpos.night.work import OnFile
from starpos.sky.catalogue import Catalogue, load_catalogue
from starpos.zenith.doubts import remarks
from starpos.zenith.reductions import reduced
from starpos.zenith.sighting import Mark, ZenithSighting

NO_DEFLECTION = 1


def define(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "frames",
        nargs="*",
        metavar="FRAME",
        help="FITS, TIFF, PNG, JPEG, HEIF, raw, or a CSV of centroids; or one rosbag2 with stars (or images) and tilts",
    )
    add_formats(
        parser, JSON_HELP, "a row of a CSV a frame, and one with combined=True; columns as keys of --json"
    )
    parser.add_argument(
        "--tilt",
        metavar="CSV",
        help="the tiltmeter's readings, as for starpos solve; not with a bag, which has them",
    )
    parser.add_argument(
        "--site",
        type=float,
        nargs=3,
        required=True,
        metavar=("LAT", "LON", "HEIGHT"),
        help="the mark on WGS 84: latitude, longitude (deg) and height (m); 1 m off is 0.03 arcsec of the deflection",
    )
    parser.add_argument(
        "--station",
        default="",
        metavar="NAME",
        help="name of the mark, for starpos stations and starpos report",
    )
    deflection_plan.add_plan(parser)
    bags.add_bag(parser)
    options.add_stamps(parser)
    options.add_instrument(parser)
    options.add_air(parser)
    jobs.add_jobs(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    mark = _mark_of(args)
    if args.plan is not None:
        return deflection_plan.run(args, mark)
    taken = _of_bag(args, mark) if _is_bag(args) else _of_files(args, mark)
    return console.UNREADABLE if taken is None else _tell(args, taken, mark)


@dataclass(frozen=True, eq=False)
class _Taken:
    """A session's frames: their names, and of each its sighting or why it has none.

    catalogue: of which the sightings' stars are rows.
    """

    names: list[str]
    answers: list[ZenithSighting | Solution | FrameError]
    instrument: Instrument
    catalogue: Catalogue


def _of_files(args: argparse.Namespace, mark: Mark) -> _Taken | None:
    """The sightings of files; None where no frame can be read, which has been said."""
    if not args.frames or args.tilt is None:
        raise InstrumentError("give frames and --tilt CSV, or a bag, or --plan SIGMA")
    read = reader_of(args)
    frames = frames_among(args.frames, args.tilt)
    with jobs.workers_of(args, len(frames)) as workers:
        (about,) = workers.map([(First(read), tuple(frames))])
        if about is None:
            # says why
            read(frames[0])
            return None
        instrument, doubt = with_frame_size(options.instrument_of(args, about), about)
        if doubt:
            console.complain("deflection", doubt)
        given = replace(given_of(args, about), instrument=instrument)
        tilts = checked_tilts("deflection", os.path.abspath(args.tilt), instrument)
        jobs.prepare("deflection", instrument, about)
        work = OnFile(read, ZenithSighted(given, options.atmosphere_of(args), tilts, mark))
        answers = list(jobs.watched(workers.map((work, path) for path in frames), len(frames), silent=False))
    _, catalogue, _ = Solver(instrument, load_catalogue()).view(about.width, about.height, about.origin_px)
    return _Taken(frames, answers, instrument, catalogue)


def _is_bag(args: argparse.Namespace) -> bool:
    bag = [path for path in args.frames if is_bag(Path(path))]
    if bag and len(args.frames) > 1:
        raise FrameError(f"{bag[0]}: a bag is a session of its own: give it alone")
    if bag and args.tilt is not None:
        raise TiltError(f"{bag[0]}: a bag has its own tilts: leave out --tilt")
    return bool(bag)


def _of_bag(args: argparse.Namespace, mark: Mark) -> _Taken:
    """The sightings of a bag's frames."""
    path = Path(args.frames[0])
    found, instruments = bags.read_bag(path, args)
    for remark in found.remarks:
        console.complain("deflection", remark)
    if found.tilts is None:
        raise TiltError(f"{path}: no usable tilt in it: record the topic tilt too")
    if not found.star_count:
        raise FrameError(f"{path}: no stars and no images in it: record the topic stars too")
    work = ZenithSighted(instruments, options.atmosphere_of(args), found.tilts, mark)
    names, answers, instrument, catalogue = [], [], instruments.instrument, load_catalogue()
    for name, item in jobs.watched(each_frame(found), found.star_count, silent=False):
        names.append(name)
        answers.append(item if isinstance(item, FrameError) else work(item))
        if isinstance(answers[-1], ZenithSighting) and (own := instruments.of(item)) is not None:
            _, catalogue, _ = Solver(own, load_catalogue()).view(item.width, item.height, item.origin_px)
    return _Taken(names, answers, instrument, catalogue)


def _tell(args: argparse.Namespace, taken: _Taken, mark: Mark) -> int:
    """Adjust the session and print it; returns the exit status."""
    output = Output(args, COLUMNS, HEAD)
    for remark in of_inclinometer(taken.instrument):
        console.complain("deflection", remark)
    rows = list(zip(taken.names, taken.answers, strict=True))
    for name, answer in rows:
        if not isinstance(answer, ZenithSighting):
            console.complain("deflection", _why(name, answer))
    sightings = [answer for answer in taken.answers if isinstance(answer, ZenithSighting)]
    try:
        session = DeflectionSession.of(sightings, taken.instrument, options.atmosphere_of(args), mark)
    except FixError as error:
        console.complain("deflection", error)
        return NO_DEFLECTION
    scale = taken.instrument.inclinometer.scale
    for said in remarks(session.adjusted, session.sightings, len(rows), scale):
        console.complain("deflection", said)
    at = {id(s): k for k, s in enumerate(session.sightings)}
    for name, answer in rows:
        if isinstance(answer, ZenithSighting):
            value = frame_json(name, session, at[id(answer)])
            output.put(value, frame_line(value))
        else:
            output.put({"file": name, "status": "left out", "message": _why(name, answer)}, "")
    without = reduced(session.adjusted, session.sightings, mark)
    whole = combined_json(session, without, mark, args.station, taken.catalogue)
    output.put(whole, combined_text(session, whole))
    return console.UNREADABLE if any(isinstance(a, FrameError) for a in taken.answers) else 0


def _mark_of(args: argparse.Namespace) -> Mark:
    latitude, longitude, height_m = args.site
    if not (abs(latitude) <= 90 and abs(longitude) <= 360 and -1000 <= height_m <= 9000):
        raise InstrumentError(
            f"--site {latitude:g} {longitude:g} {height_m:g}: give latitude and longitude in deg and the height in m"
        )
    return Mark(float(np.radians(latitude)), float(np.radians(longitude)), height_m)


def _why(path: str, answer: Solution | FrameError) -> str:
    said = str(answer) if isinstance(answer, FrameError) else answer.message
    return said if path in said else f"{path}: {said}"

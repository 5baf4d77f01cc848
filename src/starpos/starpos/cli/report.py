# SPDX-License-Identifier: Apache-2.0
"""`starpos report`: the results of a night as pictures, and as one page that any browser opens."""

import argparse
import time
from importlib.util import find_spec
from pathlib import Path

from starpos.cli import console, inputs, options
from starpos.errors import FrameError, InstrumentError
from starpos.frames.reading import are_photographs
from starpos.night.opening import exposures, frames_in
from starpos.night.reading import First, Instruments
from starpos.night.solving import Exposures, How, solved_night
from starpos.parameters.given import of_solver
from starpos.sky import catalogue
from starpos.units import utc_text

# endings of a page in one file
PAGES = (".html", ".htm")


def run(args: argparse.Namespace) -> int:
    if wrong := of_solver(args.param):
        raise InstrumentError(
            f"-p {wrong[0]}: a report has the solver's values from its other options, such as --misalignment; -p takes "
            "NODE:NAME:=VALUE of detector and inclinometer"
        )
    paths = [Path(name) for name in args.night]
    photographs = are_photographs(paths) and all(path.is_file() for path in paths)
    if len(paths) > 1 and not photographs:
        raise FrameError(f"{paths[1]}: a report is of one night: give one, or photographs")
    if args.field is not None:
        return _pack(args, paths)
    if find_spec("matplotlib") is None:
        raise InstrumentError(f"a report is drawn with matplotlib, which is not here: {inputs.PIP}")
    from starpos.report.html import PAGE, check_folder, write_files
    from starpos.report.page import page, pictures_of
    from starpos.report.photograph import named_photograph

    out = Path(args.out)
    folder, index = (out.parent, out.name) if out.suffix.lower() in PAGES else (out, PAGE)
    check_folder(folder, index)
    how = How(options.turn_of(args) if args.self_calibrate else None)
    night = solved_night(_exposures(paths, args), how, console.ProgressBar())
    for sentence in filter(None, (*night.remarks, night.why_not)):
        console.complain(f"{night.name}: {sentence}")
    pictures = list(pictures_of(night, catalogue.load_catalogue()))
    if photographs and (named := named_photograph(night, {p.name: p for p in paths})):
        pictures.insert(1, named)
    html = page(night, pictures, utc_text(time.time())[:16].replace("T", " ") + " UTC")
    # the page has its pictures
    files = {f"{p.name}.png": p.png for p in pictures} if folder == out else {}
    write_files(folder, files | {index: html.encode(errors="replace")})
    print(folder / index)
    return 0 if night.combined else console.NOTHING


def _pack(args: argparse.Namespace, paths: list[Path]) -> int:
    """Write a field report."""
    from starpos.night import field

    if not args.field.lower().endswith(field.SUFFIX):
        raise FrameError(f"--field {args.field}: give it a name that ends in {field.SUFFIX}")
    count = field.write(Path(args.field), _exposures(paths, args), console.ProgressBar())
    print(f"{args.field}: {count} frames")
    return 0


def _exposures(paths: list[Path], args: argparse.Namespace) -> Exposures:
    """The exposures of a folder, of photographs or of a bag; raises StarposError without any."""
    from starpos.night import bag

    air, vertical, path = options.atmosphere_of(args), options.vertical_of(args), paths[0]
    if not path.exists():
        raise FrameError(f"{path}: there is no such night: give a folder, a rosbag2, or photographs")
    if bag.is_bag(path):
        return bag.exposures(*inputs.read_bag(path, args), air, vertical)
    frames = paths if path.is_file() else []
    if frames and not are_photographs(frames):
        raise FrameError(
            f"{path}: neither a folder of frames nor a rosbag2 (.mcap, .db3), nor a photograph: give one of these"
        )
    read, folder = inputs.reader_of(args), path.parent if frames else path
    about = First(read)(tuple(map(str, frames or frames_in(path))))
    # a field report states the focal length
    find = inputs.given_or_sought if args.field is None else inputs.given_of
    given = Instruments(None) if about is None else find(args, about)
    return exposures(folder, given, air, vertical, read=read, frames=frames)

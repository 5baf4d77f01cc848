# SPDX-License-Identifier: Apache-2.0
"""`starpos report`: the results of nights as pictures, and as one page that any browser opens."""

import argparse
import time
from importlib.util import find_spec
from pathlib import Path

from starpos.cli import console, inputs, options, overwriting, places_file
from starpos.cli.fix_output import json_of
from starpos.cli.solve import how_of
from starpos.errors import FrameError, InstrumentError
from starpos.files import save
from starpos.frames.reading import are_photographs
from starpos.night.night import Night
from starpos.night.opening import exposures, frames_in
from starpos.night.reading import Instruments
from starpos.night.solving import Exposures, solved_night
from starpos.parameters.given import of_solver
from starpos.sky import catalogue
from starpos.units import utc_text

# endings of a page in one file
PAGES = (".html", ".htm")
INDEX = "index.html"


def run(args: argparse.Namespace) -> int:
    if wrong := of_solver(args.param):
        raise InstrumentError(
            f"-p {wrong[0]}: a report has the solver's values from its other options, such as --misalignment; -p takes "
            "NODE:NAME:=VALUE of detector and inclinometer"
        )
    if args.gnss is not None and len(args.nights) > 1:
        raise InstrumentError("--gnss is of one night: give one")
    if args.field is not None:
        return _pack(args)
    if places_file.is_places(args.out):
        return _write_places(args)
    if find_spec("matplotlib") is None:
        raise InstrumentError(f"a report is drawn with matplotlib, which is not here: {inputs.PIP}")
    from starpos.report.page import nights_picture, page, pictures_of
    from starpos.report.photograph import named_photograph

    out = Path(args.out)
    folder, index = (out.parent, out.name) if out.suffix.lower() in PAGES else (out, INDEX)
    overwriting.check(argparse.Namespace(out=folder / index), out=overwriting.ours)
    overwriting.check_folder(folder)
    groups = _groups(args.nights)
    nights = _nights(groups, args)
    bar, each = console.ProgressBar(), []
    for k, (night, paths) in enumerate(zip(nights, groups, strict=True)):
        each.append(list(pictures_of(night, catalogue.load_catalogue())))
        if are_photographs(paths) and (named := named_photograph(night, {p.name: p for p in paths})):
            each[-1].insert(1, named)
        bar("figures", (k + 1) / len(nights))
    known = [(k, n) for k, n in enumerate(nights, 1) if n.truth and n.combined]
    overall = [nights_picture(known)] if len(nights) > 1 and known else []
    now = utc_text(time.time())[:16].replace("T", " ")
    html = page(nights, each, overall, f"{now} UTC")
    files = {f"{p.name}.png": p.png for p in overall}
    for k, pictures in enumerate(each, 1):
        prefix = f"night{k}-" if len(nights) > 1 else ""
        files |= {f"{prefix}{p.name}.png": p.png for p in pictures}
    # the page has its pictures
    files = ({} if folder != out else files) | {index: html.encode(errors="replace")}
    for name in files:
        overwriting.check(argparse.Namespace(out=folder / name), out=overwriting.ours)
    for name, content in files.items():
        save(folder / name, content, "the report")
    print(folder / index)
    return 0 if any(n.combined for n in nights) else console.NOTHING


def _groups(names: list[str]) -> list[list[Path]]:
    """The paths of each night: a folder or a bag, or photographs named one by one."""
    paths = [Path(name) for name in names]
    return [paths] if are_photographs(paths) and all(p.is_file() for p in paths) else [[p] for p in paths]


def _nights(groups: list[list[Path]], args: argparse.Namespace) -> list[Night]:
    """The nights, after complaints about what is wrong with them; raises StarposError for one without frames."""
    nights = []
    for paths in groups:
        how = how_of(args)
        nights.append(solved_night(_exposures(paths, args), how, console.ProgressBar()))
    for night in nights:
        console.complain_of(night.name, *night.remarks, night.why_not)
    return nights


def _write_places(args: argparse.Namespace) -> int:
    """Write the places of nights for maps, without a page."""
    overwriting.check(args, out=overwriting.ours)
    answers: list[dict] = []
    for night in _nights(_groups(args.nights), args):
        answers += [{"file": s.name} | json_of(s.place, night.vertical) for _, s in night.fixed]
        answers.append({"combined": True, "night": night.name} | json_of(night.combined, night.vertical))
    places_file.write(args.out, answers)
    print(args.out)
    return 0 if answers[-1]["utc"] else console.NOTHING


def _pack(args: argparse.Namespace) -> int:
    """Write a field report of one night."""
    from starpos.night import field

    if len(args.nights) > 1:
        raise FrameError("--field packs one night: give one")
    field.check_name(args.field)
    count = field.write(Path(args.field), _exposures([Path(args.nights[0])], args), console.ProgressBar())
    print(f"{args.field}: {count} frames")
    return 0


def _exposures(paths: list[Path], args: argparse.Namespace) -> Exposures:
    """The exposures of a folder, of photographs or of a bag; raises StarposError without any."""
    from starpos.night import bag

    vertical, path = options.vertical_of(args), paths[0]
    if not path.exists():
        raise FrameError(f"{path}: there is no such night: give a folder, a rosbag2, or photographs")
    if bag.is_bag(path):
        if args.gnss is not None:
            raise FrameError(f"{path}: --gnss goes with a folder of frames, and this is a bag: leave it out")
        return inputs.bag_of(path, args, vertical)
    frames = paths if path.is_file() else []
    if frames and not are_photographs(frames):
        raise FrameError(
            f"{path}: neither a folder of frames nor a rosbag2 (.mcap, .db3), nor a photograph: give one of these"
        )
    read, folder = inputs.reader_of(args), path.parent if frames else path
    about = read.first(list(map(str, frames or frames_in(path))))
    # a field report states the focal length
    find = inputs.given_or_sought if args.field is None else inputs.given_of
    given = Instruments(None) if about is None else find(args, about)
    air = options.atmosphere_of(args)
    return exposures(folder, given, air, vertical, read=read, frames=frames)

# SPDX-License-Identifier: Apache-2.0
"""`starpos report`: the results of nights as pictures, and as one page that any browser opens."""

import argparse
import time
from collections.abc import Callable
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from starpos.cli import console, options
from starpos.cli.deflection import add_vertical, vertical_of
from starpos.errors import FrameError, InstrumentError
from starpos.frames.stars import Stars, no_stars
from starpos.instrument.instrument import Instrument
from starpos.report.night import Night
from starpos.sky import catalogue
from starpos.utc import utc_text

if TYPE_CHECKING:
    from starpos.report.bag import Recorded

NO_FIX = 1
# so many nights get all their figures; more get the table and the errors only
ALL_FIGURES = 6
PIP = "pip install matplotlib rosbags"


def define(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "nights",
        nargs="+",
        metavar="NIGHT",
        help="a folder of frames (FITS, or CSV of stars) with tilt.csv and perhaps truth.json, or a rosbag2",
    )
    parser.add_argument(
        "-o", "--out", default="starpos-report", metavar="FOLDER", help="index.html and PNGs (starpos-report)"
    )
    parser.add_argument("--namespace", metavar="NAME", help="of the instrument, in a bag that holds several")
    options.add_instrument(parser)
    options.add_air(parser)
    add_vertical(parser)
    options.add_self_calibration(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    options.check_self_calibration(args)
    if find_spec("matplotlib") is None:
        raise InstrumentError(f"a report is drawn with matplotlib, which is not here: {PIP}")
    from starpos.report.page import page
    from starpos.report.pictures import nights_picture, pictures_of
    from starpos.report.writing import PAGE, check, write

    check(Path(args.out))
    nights = [_night(Path(path), args) for path in args.nights]
    for night in nights:
        for sentence in (*night.remarks, *([night.why_not] if night.why_not else [])):
            console.complain("report", f"{night.name}: {sentence}")
    bar, each = console.ProgressBar(), []
    for k, night in enumerate(nights):
        each.append(
            list(pictures_of(night, catalogue.load_catalogue())) if len(nights) <= ALL_FIGURES else []
        )
        bar("figures", (k + 1) / len(nights))
    known = [(k, n) for k, n in enumerate(nights, 1) if n.truth and n.combined]
    overall = [nights_picture(known)] if len(nights) > 1 and known else []
    html = page(nights, each, overall, utc_text(time.time())[:16].replace("T", " ") + " UTC")
    files = {f"{p.name}.png": p.png for p in overall}
    for k, pictures in enumerate(each, 1):
        prefix = f"night{k}-" if len(nights) > 1 else ""
        files |= {f"{prefix}{p.name}.png": p.png for p in pictures}
    write(Path(args.out), files | {PAGE: html.encode(errors="replace")})
    print(Path(args.out) / PAGE)
    return 0 if any(n.combined for n in nights) else NO_FIX


def _night(path: Path, args: argparse.Namespace) -> Night:
    """The Night of a folder or a bag; raises StarposError if there is nothing to work on."""
    from starpos.report import bag, folder, recorded
    from starpos.report.working import Workshop, worked

    shop = Workshop(
        instrument_for=_once_a_size(lambda stars: options.instrument_of(args, stars)),
        catalogue=catalogue.load_catalogue(),
        atmosphere=options.atmosphere_of(args),
        vertical=vertical_of(args),
        turn_stddev_deg=options.turn_of(args) if args.self_calibrate else None,
        progress=console.ProgressBar(),
    )
    if not path.exists():
        raise FrameError(f"{path}: there is no such night: give a folder, or a rosbag2")
    if not bag.is_bag(path):
        if path.is_file():
            raise FrameError(
                f"{path}: neither a folder of frames nor a rosbag2 (.mcap, .db3): give one of these"
            )
        return worked(folder.exposures(path, _tilt_noise(args)), shop)
    if find_spec("rosbags") is None:
        raise FrameError(f"{path}: bags are read with rosbags, which is not here: {PIP}")
    found = bag.read(path, args.namespace, _tilt_noise(args), shop.progress)
    return recorded.night(found, replace(shop, instrument_for=_once_a_size(_with_camera(args, found))))


def _tilt_noise(args: argparse.Namespace) -> float:
    """Noise in rad of a tilt that does not state its own."""
    return _instrument(args).inclinometer.noise_rad


def _instrument(args: argparse.Namespace) -> Instrument:
    """The instrument of the options, with any camera."""
    return options.instrument_of(args, no_stars(100, 100, focal_px=1000.0))


def _once_a_size(instrument_for: Callable[[Stars], Instrument]) -> Callable[[Stars], Instrument]:
    """A function like `instrument_for` that asks it only for the first frame of each size."""
    known: dict[tuple[int, int], Instrument] = {}

    def remembered(stars: Stars) -> Instrument:
        size = stars.width, stars.height
        if size not in known:
            known[size] = instrument_for(stars)
        return known[size]

    return remembered


def _with_camera(args: argparse.Namespace, found: "Recorded") -> Callable[[Stars], Instrument]:
    """A function that gives the instrument for a frame, with the bag's camera unless the options have a focal length."""

    def instrument_for(stars: Stars) -> Instrument:
        camera = found.cameras.get((stars.width, stars.height))
        if args.focal_mm is not None or camera is None:
            return options.instrument_of(args, stars)
        return replace(_instrument(args), camera=camera, focal_px=camera.fx)

    return instrument_for

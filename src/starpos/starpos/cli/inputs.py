# SPDX-License-Identifier: Apache-2.0
"""What the options state of a night's frames: how they are read, their instrument, tilts, and expected place."""

import argparse
import math

from starpos.cli import console, options
from starpos.errors import InstrumentError
from starpos.instrument.instrument import Instrument
from starpos.instrument.lens import PLUMB_BOB
from starpos.night.doubts import NEAR_KM, Near
from starpos.night.reading import About, Given, Reader, TiltFile
from starpos.night.remarks import of_tilts


def reader_of(args: argparse.Namespace) -> Reader:
    """The reader of frames with the clock and the delay of their shutter that the options give."""
    return Reader(options.clock_of(args), tuple(args.shutter_delay or (0.0, 0.0)))


def given_of(args: argparse.Namespace, first: About | None) -> Given:
    """The instrument of each frame; the focal length is from its header unless the options give one.

    Raises InstrumentError if the options do not fit together, or the first frame has no focal length either.
    """
    return Given(
        options.instrument_of(args, first), by_header=(args.instrument, args.focal_mm) == (None, None)
    )


def is_untold(args: argparse.Namespace) -> bool:
    """Whether the options say nothing of the camera."""
    return (args.instrument, args.focal_mm, args.pixel_um) == (None,) * 3 and args.lens == PLUMB_BOB


def checked_tilts(command: str, path: str, instrument: Instrument) -> TiltFile:
    """The table of tilts, with a complaint where it looks like radians; raises TiltError as `read_tilt_csv` does."""
    file = TiltFile(path, instrument.inclinometer.noise_rad)
    for remark in of_tilts(file.log, path):
        console.complain(command, remark)
    return file


def add_near(parser: argparse.ArgumentParser) -> None:
    """Add the options that `near_of` reads."""
    parser.add_argument(
        "--near",
        type=float,
        nargs=2,
        metavar=("LAT", "LON"),
        help="approximate position of the instrument, deg: a fix far from it is reported with likely causes "
        "and never changed; for pointings without a roll it selects between two possible places",
    )
    parser.add_argument(
        "--near-km",
        type=float,
        metavar="KM",
        help=f"distance from --near within which the fix is expected ({NEAR_KM:g}; 4 sigma of the fix are "
        f"added)",
    )


def near_of(args: argparse.Namespace) -> Near | None:
    """The place of --near; None without it.  Raises InstrumentError."""
    if args.near is None:
        if args.near_km is not None:
            raise InstrumentError("--near-km is for --near: give both")
        return None
    latitude, longitude = args.near
    if not (abs(latitude) <= 90 and abs(longitude) <= 360):
        raise InstrumentError(f"--near {latitude:g} {longitude:g}: give latitude and longitude in deg")
    km = NEAR_KM if args.near_km is None else args.near_km
    if not 0 < km <= 20_000:
        raise InstrumentError(f"--near-km {km:g}: give a distance above 0 and at most 20000")
    return Near(math.radians(latitude), math.radians(longitude), km)

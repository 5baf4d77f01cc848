# SPDX-License-Identifier: Apache-2.0
"""What the commands share: the instrument's and the air's options, reading frames, JSON without NaN, progress."""

import argparse
import json
import math
import sys
import time

import numpy as np

from starpos.earth import geoid
from starpos.earth.refraction import Atmosphere
from starpos.earth.vertical import UNKNOWN_STDDEV_ARCSEC, Deflection, Vertical
from starpos.errors import FrameError, InstrumentError, StarposError
from starpos.frames.exif import UNTENDED_STDDEV_S, ZONES_H, CameraClock
from starpos.frames.frame import Frame
from starpos.frames.reading import read_frame
from starpos.frames.stars import Stars
from starpos.instrument import instrument, instrument_file
from starpos.instrument.camera import Camera

GIVEN_STDDEV_ARCSEC = 1.0  # of a deflection given by hand without its error


def add_frames(
    parser: argparse.ArgumentParser, json_help: str = "one JSON object a frame instead of a table"
) -> None:
    parser.add_argument(
        "frames", nargs="+", metavar="FRAME", help="FITS, TIFF, PNG, raw, or a CSV of centroids"
    )
    parser.add_argument("--json", action="store_true", help=json_help)


def add_exif(parser: argparse.ArgumentParser) -> None:
    """What `clock_of` reads."""
    parser.add_argument(
        "--exif-utc-offset",
        type=_utc_offset,
        metavar="HOURS|file",
        help="take the time of raw files, TIFF and JPEG from EXIF: by how much the camera's clock was ahead of UTC "
        "(file: as each file says)",
    )
    parser.add_argument(
        "--exif-clock-stddev",
        type=number(0, 86400),
        metavar="S",
        help=f"how far that clock may be off ({UNTENDED_STDDEV_S:g}; 1 s is 464 m at the equator)",
    )


FILES_OWN = "file"


def _utc_offset(text: str) -> float | str:
    return FILES_OWN if text == FILES_OWN else number(-ZONES_H, ZONES_H)(text)


_utc_offset.__name__ = "float"  # what argparse calls it


def clock_of(args: argparse.Namespace) -> CameraClock | None:
    """The clock that wrote the files' EXIF; None where nobody vouches for it."""
    offset_h, stddev_s = args.exif_utc_offset, args.exif_clock_stddev
    if offset_h is None:
        if stddev_s is not None:
            raise InstrumentError("--exif-clock-stddev is for --exif-utc-offset: give both")
        return None
    return CameraClock(
        None if offset_h == FILES_OWN else offset_h, UNTENDED_STDDEV_S if stddev_s is None else stddev_s
    )


def add_optics(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--focal-mm", type=float, metavar="MM", help="focal length; within 3 %%")
    parser.add_argument("--pixel-um", type=float, metavar="UM", help="pixel size")


def add_instrument(parser: argparse.ArgumentParser) -> None:
    """What `instrument_of` reads."""
    parser.add_argument(
        "--instrument", metavar="FILE", help="instrument file (YAML) instead of the three options below"
    )
    add_optics(parser)
    parser.add_argument(
        "--misalignment",
        type=float,
        nargs=3,
        metavar=("RX", "RY", "RZ"),
        help="A3 in deg: camera to inclinometer",
    )


def add_turn(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--turn-stddev",
        type=number(1e-6, 180),
        metavar="DEG",
        help="how well the given A3 has its turn about the plumb line, the way the inclinometer faces (180: not at all)",
    )


def turn_of(args: argparse.Namespace) -> float:
    """deg; what --turn-stddev says."""
    return 180.0 if args.turn_stddev is None else args.turn_stddev


def add_self_calibration(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--self-calibrate",
        action="store_true",
        help="frames of one place at several headings: find A3 too, whatever it is",
    )
    add_turn(parser)


def check_self_calibration(args: argparse.Namespace) -> None:
    """InstrumentError for a turn's error that nothing would take note of."""
    if args.turn_stddev is not None and not args.self_calibrate:
        raise InstrumentError("--turn-stddev is for --self-calibrate: give both")


def add_size(parser: argparse.ArgumentParser) -> None:
    """Frame size; with it the optics are the paper's where they are not given."""
    size = {"type": number(16, 100_000, int), "metavar": ("W", "H"), "nargs": 2, "default": (5616, 3744)}
    parser.add_argument("--size", **size, help="frame size in px (5616 3744)")
    parser.set_defaults(focal_mm=600.0, pixel_um=6.4)


def camera_of(args: argparse.Namespace) -> Camera:
    """An ideal camera from --focal-mm, --pixel-um and --size."""
    return Camera.from_focal(*args.size, instrument.focal_px_of(args.focal_mm, args.pixel_um))


def add_air(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--pressure-hpa", type=float, metavar="HPA", help="air pressure at the instrument, not reduced"
    )
    parser.add_argument("--temperature-c", type=float, metavar="C", help="air temperature")
    parser.add_argument("--humidity", type=float, default=0.3, metavar="0..1", help="relative humidity (0.3)")


def add_vertical(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--xi", type=float, metavar="ARCSEC", help="deflection of the vertical, north (0)")
    parser.add_argument("--eta", type=float, metavar="ARCSEC", help="deflection of the vertical, east (0)")
    parser.add_argument(
        "--deflection-stddev", type=float, metavar="ARCSEC", help="its error a component (6, or 1 if given)"
    )
    parser.add_argument(
        "--geoid",
        metavar="FILE",
        help="take the deflection and its error from a geoid grid, GTX or GeoTIFF, such as egm96_15.gtx of proj-data",
    )


def vertical_of(args: argparse.Namespace) -> Vertical:
    """The deflection given by hand, or a geoid's; that of knowing nothing without either."""
    by_hand = args.xi, args.eta, args.deflection_stddev
    if args.geoid is not None:
        if by_hand != (None, None, None):
            raise InstrumentError(
                "--geoid tells the deflection and its error: give either it or --xi, --eta and theirs"
            )
        return geoid.read(args.geoid)
    stddev = args.deflection_stddev
    if stddev is None:
        stddev = GIVEN_STDDEV_ARCSEC if args.xi or args.eta else UNKNOWN_STDDEV_ARCSEC
    return Deflection(args.xi or 0.0, args.eta or 0.0, stddev)


def number(low: float, high: float, kind: type = float):
    """An argparse type: a number from low to high."""

    def parse(text: str):
        value = kind(text)
        if not low <= value <= high:
            raise argparse.ArgumentTypeError(f"{text} must lie between {low:g} and {high:g}")
        return value

    parse.__name__ = kind.__name__  # what argparse calls it
    return parse


def atmosphere_of(args: argparse.Namespace) -> Atmosphere:
    """The air as far as it was given."""
    pressure_pa = None if args.pressure_hpa is None else args.pressure_hpa * 100
    return Atmosphere.measured(pressure_pa, args.temperature_c, args.humidity)


def instrument_of(args: argparse.Namespace, first: Frame | Stars | None) -> instrument.Instrument:
    """From --instrument, or --focal-mm and --pixel-um, or what the first frame's header says."""
    path = getattr(args, "instrument", None)
    misalignment = getattr(args, "misalignment", None)
    flat = args.focal_mm is not None or args.pixel_um is not None or misalignment is not None
    if path is not None:
        if flat:
            raise InstrumentError(
                "--instrument holds focal length and misalignment: give either it or the options"
            )
        return instrument_file.read(path)
    if (args.focal_mm is None) != (args.pixel_um is None):
        raise InstrumentError("--focal-mm and --pixel-um belong together: give both")
    if args.focal_mm is not None:
        focal_px = instrument.focal_px_of(args.focal_mm, args.pixel_um)
    elif first is not None and first.focal_px is not None:
        focal_px = first.focal_px
    else:
        raise InstrumentError(
            "no focal length: give --focal-mm and --pixel-um, or frames whose header has them"
        )
    return instrument.Instrument(
        focal_px, calibration=instrument.Calibration(misalignment_deg=tuple(misalignment or (0.0, 0.0, 0.0)))
    )


def frames_of(paths: list[str], clock: CameraClock | None = None):
    """(path, Frame or Stars or FrameError) of each, read one at a time."""
    for path in paths:
        try:
            yield path, read_frame(path, clock)
        except FrameError as e:
            yield path, e


def stars_of(item: Frame | Stars) -> Stars:
    """Detected stars, or the given ones."""
    if isinstance(item, Stars):
        return item
    from starpos.detection import detect

    return detect(item).stars


def print_json(value: dict) -> None:
    """One line; numbers that are none become null."""
    print(json.dumps(_plain(value)), flush=True)


def _plain(value):
    if isinstance(value, dict):
        return {k: _plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple, np.ndarray)):
        return [_plain(v) for v in value]
    if isinstance(value, (float, np.floating)):
        return float(value) if math.isfinite(value) else None
    if isinstance(value, np.integer):
        return int(value)
    return value


def tell_unknown(command: str, args: argparse.Namespace, deflection: Deflection) -> None:
    """One line where a geoid was given and has nothing to say about the place."""
    if args.geoid is not None and deflection == Deflection():
        stddev = deflection.stddev_arcsec
        complain(
            command, f"{args.geoid}: no data around this place; the deflection is unknown, {stddev:g} arcsec"
        )


def complain(command: str, error: StarposError | str) -> None:
    if sys.stderr.isatty():
        print("\r\x1b[K", end="", file=sys.stderr)  # a progress bar may stand there
    print(f"starpos {command}: {error}", file=sys.stderr)


def tell_extrapolation(command: str, solved: list) -> None:
    """One line for all Solutions whose Earth rotation is beyond the table: the days and the error of the worst."""
    worst = max(solved, key=lambda s: s.extrapolated_days, default=None)
    if worst is not None and worst.extrapolated_days > 0:
        (ut1,) = (t for t in worst.fix.terms if t.name == "ut1")
        complain(
            command,
            f"the Earth's rotation is extrapolated {worst.extrapolated_days:.0f} days beyond the IERS table, "
            f"{np.sqrt(ut1.covariance[0, 0]):.0f} m east (1 sigma, in the budget): upgrade astropy-iers-data",
        )


UNREADABLE = 2  # exit status


class ProgressBar:
    """A bar on standard error for work of more than half a second; silent where that is no terminal."""

    def __init__(self):
        self.begin = time.monotonic()
        self.shown = False

    def __call__(self, what: str, done: float) -> None:
        if not sys.stderr.isatty() or (time.monotonic() - self.begin < 0.5 and not self.shown):
            return
        self.shown = True
        filled = int(30 * min(done, 1.0))
        end = "\n" if done >= 1 else ""
        print(
            f"\r{what:>20} [{'#' * filled}{'.' * (30 - filled)}] {100 * done:3.0f} %",
            end=end,
            file=sys.stderr,
            flush=True,
        )

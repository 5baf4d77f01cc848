# SPDX-License-Identifier: Apache-2.0
"""Options shared by several commands: frames, instrument, air, deflection, known place; the objects made from them."""

import argparse
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from starpos.cli import console
from starpos.earth import geoid
from starpos.earth.place import Place
from starpos.earth.refraction import Atmosphere
from starpos.earth.vertical import UNKNOWN_STDDEV_ARCSEC, AtHeight, Deflection, Vertical
from starpos.errors import InstrumentError
from starpos.frames.exif import NETWORK_STDDEV_S, UNTENDED_STDDEV_S, ZONES_H, CameraClock
from starpos.frames.exposure import MAX_READOUT_S, UNKNOWN_SHUTTER, Shutter
from starpos.instrument import instrument, instrument_file, sensors
from starpos.instrument.camera import EQUIDISTANT, PLUMB_BOB, Camera
from starpos.instrument.instrument import UNKNOWN_CLOCK_S
from starpos.recording import topics


def add_frames(parser: argparse.ArgumentParser, pointings: bool = False) -> None:
    """Add the frames; with `pointings` also --pointings, which may stand in for frames."""
    parser.add_argument(
        "frames",
        nargs="*" if pointings else "+",
        metavar="FRAME",
        help="FITS (an HDU of several: 'a.fits[2]' or 'a.fits[SCI]'), TIFF, PNG, JPEG, BMP, HEIF, raw, or a CSV of "
        "centroids",
    )
    if pointings:
        parser.add_argument(
            "--pointings",
            metavar="CSV",
            help="instead of frames, what a plate solver found for them: utc_unix_s (mid-exposure), ra_deg, dec_deg, "
            "roll_deg, sigma_arcsec, sigma_roll_arcsec[, exposure_s]: ICRS of the frame's centre, the position angle of "
            "its top from north over east, 1 sigma of the centre along each of two axes and of the turn about it; "
            "without a roll only elevations count: they give a position from three directions or more, and "
            "no heading",
        )


def add_parameters(parser: argparse.ArgumentParser, whose: str, such_as: str) -> None:
    """Add --params-file and --param; whose: of which nodes.  such_as: an example."""
    parser.add_argument(
        "--params-file", type=Path, metavar="YAML", help=f"parameters, as ROS's files have them, {whose}"
    )
    parser.add_argument(
        "-p",
        "--param",
        action="append",
        default=[],
        metavar="[NODE:]NAME:=VALUE",
        help=f"a parameter, such as {such_as}, of the solver unless a node is named; it overrides the file's",
    )


def add_remaps(parser: argparse.ArgumentParser) -> None:
    """Add --remap, which `remaps_of` reads."""
    parser.add_argument(
        "--remap",
        action="append",
        default=[],
        metavar="NAME:=TOPIC",
        help=f"the bag's topic to use as one of {', '.join(topics.DRIVER_INPUTS)}, such as "
        "camera/image_raw:=/cam0/image_raw; without it the one with this name, or the only one of its type",
    )


def remaps_of(args: argparse.Namespace) -> topics.Remaps:
    """The topics of --remap; raises FrameError."""
    return topics.Remaps.of(args.remap)


def check_frames(args: argparse.Namespace) -> None:
    """Raise InstrumentError unless there are either frames or --pointings."""
    if bool(args.frames) == (args.pointings is not None):
        raise InstrumentError("give either frames or --pointings CSV" + (", not both" if args.frames else ""))
    if args.pointings is not None and (args.shutter_delay, args.readout) != (None, None):
        raise InstrumentError(
            "--shutter-delay and --readout are for frames: the times in --pointings are when the sky was seen"
        )


def has_own_level(args: argparse.Namespace) -> bool:
    """Whether --instrument is the file of a camera fixed to the ground; InstrumentError if there is a --tilt too."""
    if args.instrument is None:
        return False
    pointed = getattr(args, "pointings", None) is not None
    if instrument_file.read(args.instrument, needs_camera=not pointed).vertical is None:
        return False
    if args.tilt is not None or getattr(args, "self_calibrate", False):
        raise InstrumentError(
            f"{args.instrument} describes a camera fixed to the ground, without an inclinometer: leave out --tilt "
            "and --self-calibrate, or give another instrument file"
        )
    return True


def add_stamps(parser: argparse.ArgumentParser) -> None:
    """Add the options of the frames' times, which `clock_of` and `inputs.reader_of` read."""
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
        help=f"how far that clock may be off ({UNTENDED_STDDEV_S:g}, a telephone's {NETWORK_STDDEV_S:g}; 1 s is 464 m at "
        "the equator)",
    )
    parser.add_argument(
        "--shutter-delay",
        type=number(-10, 60),
        nargs=2,
        metavar=("S", "STDDEV"),
        help="s from the start of an exposure by the frame's header until the shutter opened, and its error "
        "(0; of raw files and JPEG with an error of 0.06 by themselves)",
    )


FILES_OWN = "file"


def _utc_offset(text: str) -> float | str:
    return FILES_OWN if text == FILES_OWN else number(-ZONES_H, ZONES_H)(text)


# the name that argparse prints
_utc_offset.__name__ = "float"


def clock_of(args: argparse.Namespace) -> CameraClock | None:
    """The clock that wrote the times in EXIF; None if the options do not give it.  Raises InstrumentError."""
    offset_h, stddev_s = args.exif_utc_offset, args.exif_clock_stddev
    if offset_h is None:
        if stddev_s is not None:
            raise InstrumentError("--exif-clock-stddev is for --exif-utc-offset: give both")
        return None
    return CameraClock(None if offset_h == FILES_OWN else offset_h, stddev_s)


def add_optics(parser: argparse.ArgumentParser) -> None:
    """Add --focal-mm and --pixel-um."""
    parser.add_argument("--focal-mm", type=float, metavar="MM", help="focal length; within 3 %%")
    parser.add_argument("--pixel-um", type=float, metavar="UM", help="pixel size")


def add_lens(parser: argparse.ArgumentParser) -> None:
    """Add --lens, the model of a lens that is not calibrated yet."""
    parser.add_argument(
        "--lens",
        choices=(PLUMB_BOB, EQUIDISTANT),
        default=PLUMB_BOB,
        help="model of a lens whose calibration is not known (plumb_bob: a pinhole; equidistant: a fisheye)",
    )


def add_instrument(parser: argparse.ArgumentParser) -> None:
    """Add the options that `instrument_of` reads."""
    parser.add_argument(
        "--instrument", metavar="FILE", help="instrument file (YAML) instead of the six options below"
    )
    add_optics(parser)
    add_lens(parser)
    parser.add_argument(
        "--misalignment",
        type=float,
        nargs=3,
        metavar=("RX", "RY", "RZ"),
        help="A3 in deg: camera to inclinometer",
    )
    parser.add_argument(
        "--misalignment-stddev",
        type=number(0, 360_000),
        metavar="ARCSEC",
        help="error of A3 about each axis; without it A3 counts as unknown (10 deg and any turn, over 1000 "
        "km)",
    )
    parser.add_argument(
        "--inclinometer",
        metavar="MODEL",
        help=f"take the inclinometer's errors from its data sheet: {', '.join(sensors.presets())} "
        "(else those of an SCA100T as sold: 7 km or more)",
    )
    parser.add_argument(
        "--readout",
        type=number(-MAX_READOUT_S, MAX_READOUT_S),
        nargs=2,
        metavar=("S", "STDDEV"),
        help="rolling shutter: s from the row read first to the last, negative where the bottom row is first, and its "
        "error; 0 0 is a global shutter (that of the instrument file, else ROLLSHUT of the frames, else not known, "
        f"{UNKNOWN_SHUTTER.readout_s:g} {UNKNOWN_SHUTTER.readout_stddev_s:g})",
    )
    add_clock(parser)


def add_clock(parser: argparse.ArgumentParser) -> None:
    """Add --clock-stddev."""
    parser.add_argument(
        "--clock-stddev",
        type=number(0, 86400),
        metavar="S",
        help=f"error of the clock that stamped the frames (that of the instrument file, else {UNKNOWN_CLOCK_S:g}; 1 s is "
        "464 m at the equator)",
    )


def add_turn(parser: argparse.ArgumentParser) -> None:
    """Add the option that `turn_of` reads."""
    parser.add_argument(
        "--turn-stddev",
        type=number(1e-6, 180),
        metavar="DEG",
        help="error of the given A3's turn about the plumb line, the direction the inclinometer faces (180: "
        "unknown)",
    )


def turn_of(args: argparse.Namespace) -> float:
    """Sigma in deg of A3's turn about the plumb line, from --turn-stddev."""
    return 180.0 if args.turn_stddev is None else args.turn_stddev


def add_self_calibration(parser: argparse.ArgumentParser) -> None:
    """Add --self-calibrate and --turn-stddev."""
    parser.add_argument(
        "--self-calibrate",
        action="store_true",
        help="frames of one place at several headings: find A3 too, whatever it is",
    )
    add_turn(parser)


def check_self_calibration(args: argparse.Namespace) -> None:
    """Raise InstrumentError for a --turn-stddev that would be ignored."""
    if args.turn_stddev is not None and not args.self_calibrate:
        raise InstrumentError("--turn-stddev is for --self-calibrate: give both")


def add_size(parser: argparse.ArgumentParser) -> None:
    """Add the frame size, and make the paper's optics the default."""
    add_frame_size(parser)
    parser.set_defaults(focal_mm=600.0, pixel_um=6.4)


def add_frame_size(parser: "argparse._ActionsContainer") -> None:
    """Add --size, the paper's by default."""
    parser.add_argument(
        "--size",
        type=number(16, 100_000, int),
        nargs=2,
        default=(5616, 3744),
        metavar=("W", "H"),
        help="frame size in px (5616 3744)",
    )


def camera_of(args: argparse.Namespace) -> Camera:
    """An ideal camera from --focal-mm, --pixel-um and --size."""
    width, height = args.size
    return Camera.from_focal(width, height, instrument.focal_px_of(args.focal_mm, args.pixel_um))


def add_air(parser: argparse.ArgumentParser) -> None:
    """Add the options that `atmosphere_of` reads."""
    parser.add_argument(
        "--pressure-hpa",
        type=float,
        metavar="HPA",
        help="air pressure at the instrument, not reduced: 300 to 1200, or 0 for a vacuum",
    )
    parser.add_argument("--temperature-c", type=float, metavar="C", help="air temperature")
    parser.add_argument("--humidity", type=float, metavar="0..1", help="relative humidity")
    parser.add_argument(
        "--wavelength-um",
        type=float,
        metavar="UM",
        help="mean wavelength of the light that the camera sees (0.55)",
    )


def number(low: float, high: float, kind: type[int] | type[float] = float) -> Callable[[str], Any]:
    """An argparse type: a number of a kind, from low to high."""

    def parse(text: str) -> float:
        value = kind(text)
        if not low <= value <= high:
            raise argparse.ArgumentTypeError(f"{text} must lie between {low:g} and {high:g}")
        return value

    # the name that argparse prints
    parse.__name__ = kind.__name__
    return parse


def degrees(text: str) -> float:
    """An argparse type: degrees, or degrees, minutes and seconds as 47:06:00 and -33:52:10.4."""
    parts = re.fullmatch(r"([+-]?)(\d{1,3}):([0-5]?\d)(?::([0-5]?\d(?:\.\d*)?))?", text.strip())
    if parts is None:
        try:
            return float(text)
        except ValueError:
            raise argparse.ArgumentTypeError(
                f"{text!r} is no angle: give deg, such as 47.1 or 47:06:00, south and west negative"
            ) from None
    value = int(parts[2]) + int(parts[3]) / 60 + float(parts[4] or 0) / 3600
    return -value if parts[1] == "-" else value


def atmosphere_of(args: argparse.Namespace) -> Atmosphere:
    """The air from the options, as far as they give it; `args.air`: from a field report."""
    if (stated := getattr(args, "air", None)) is not None:
        return stated
    pressure_pa = None if args.pressure_hpa is None else args.pressure_hpa * 100
    return Atmosphere.measured(pressure_pa, args.temperature_c, args.humidity, args.wavelength_um)


def instrument_of(args: argparse.Namespace, first: "HasFocalLength | None") -> instrument.Instrument:
    """The instrument from --instrument, or from --focal-mm and --pixel-um, or from the first frame's header.

    Raises InstrumentError if the options do not fit together or there is no focal length.
    """
    path = getattr(args, "instrument", None)
    misalignment = getattr(args, "misalignment", None)
    stddev = getattr(args, "misalignment_stddev", None)
    model = getattr(args, "inclinometer", None)
    lens = getattr(args, "lens", PLUMB_BOB)
    flat = (args.focal_mm, args.pixel_um, misalignment, stddev, model) != (None,) * 5 or lens != PLUMB_BOB
    if stddev is not None and misalignment is None:
        raise InstrumentError("--misalignment-stddev is the error of --misalignment: give both")
    if path is not None:
        if flat:
            raise InstrumentError(
                "--instrument holds focal length, lens, misalignment and the inclinometer: give either it or the options"
            )
        pointed = getattr(args, "pointings", None) is not None
        return _with_times(instrument_file.read(path, needs_camera=not pointed), args)
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
    known = () if stddev is None else ((stddev,) * 3,)
    model, errors = sensors.find(model or "")
    made = instrument.Instrument(
        focal_px,
        model=lens,
        calibration=instrument.Calibration.of(misalignment or (0.0, 0.0, 0.0), *known),
        inclinometer=errors,
        inclinometer_model=model,
    )
    return _with_times(made, args)


def _with_times(known: instrument.Instrument, args: argparse.Namespace) -> instrument.Instrument:
    """The instrument with its clock's error from --clock-stddev and its shutter from --readout, as far as given."""
    stddev, readout = getattr(args, "clock_stddev", None), getattr(args, "readout", None)
    if stddev is not None:
        known = replace(known, clock_stddev_s=stddev)
    return known if readout is None else replace(known, shutter=Shutter(*readout))


class HasFocalLength(Protocol):
    """A frame, or its header's facts."""

    @property
    def focal_px(self) -> float | None:
        """Focal length in px from the frame's header; None without one."""


# sigma of a deflection that is given by hand without one
GIVEN_STDDEV_ARCSEC = 1.0


def add_vertical(parser: argparse.ArgumentParser) -> None:
    """Add the options that `vertical_of` reads."""
    parser.add_argument("--xi", type=float, metavar="ARCSEC", help="deflection of the vertical, north (0)")
    parser.add_argument("--eta", type=float, metavar="ARCSEC", help="deflection of the vertical, east (0)")
    parser.add_argument(
        "--deflection-stddev", type=float, metavar="ARCSEC", help="its error a component (6, or 1 if given)"
    )
    parser.add_argument(
        "--geoid",
        metavar="FILE",
        help="deflection and its error from a geoid grid (GTX, NGS .bin, GeoTIFF), such as egm96_15.gtx of proj-data",
    )
    parser.add_argument(
        "--altitude-m",
        type=number(-1000, 100_000),
        metavar="M",
        help="height above the ellipsoid: plumb lines curve by 0.17 arcsec (5 m) a km at 45 deg; not with "
        "--xi and --eta, which hold at the instrument",
    )


def vertical_of(args: argparse.Namespace) -> Vertical:
    """The deflection that is given by hand or by a geoid; without either an unknown one.  Raises StarposError.

    A deflection given by hand holds at the instrument; others hold at the geoid, and plumb lines curve above it.
    """
    by_hand = args.xi, args.eta, args.deflection_stddev
    if args.geoid is not None:
        if by_hand != (None, None, None):
            raise InstrumentError(
                "--geoid gives the deflection and its error: give either --geoid or --xi, --eta and "
                "--deflection-stddev"
            )
        return _at_height(geoid.read(args.geoid), args)
    if by_hand == (None, None, None):
        return _at_height(Deflection(), args)
    if args.altitude_m is not None:
        raise InstrumentError(
            "--altitude-m is for a deflection at the geoid: leave it out, --xi and --eta hold at the "
            "instrument"
        )
    stddev = args.deflection_stddev
    if stddev is None:
        stddev = GIVEN_STDDEV_ARCSEC if args.xi or args.eta else UNKNOWN_STDDEV_ARCSEC
    return Deflection(args.xi or 0.0, args.eta or 0.0, stddev)


def _at_height(vertical: Vertical, args: argparse.Namespace) -> AtHeight:
    return AtHeight(vertical) if args.altitude_m is None else AtHeight(vertical, args.altitude_m)


def tell_unknown(command: str, args: argparse.Namespace, deflection: Deflection) -> None:
    """Complain if the geoid that was given has no data at the place."""
    if args.geoid is not None and not deflection.known:
        stddev = deflection.stddev_arcsec
        console.complain(
            command,
            f"{args.geoid}: no data around this place; the deflection is unknown, {stddev:.2g} arcsec",
        )


def add_site(parser: argparse.ArgumentParser) -> None:
    """Add the options that `place_of` reads."""
    parser.add_argument(
        "--site",
        type=degrees,
        nargs="+",
        metavar=("LAT", "LON HEIGHT"),
        help="known position, deg (by gravity unless --geodetic), and optionally its height above the "
        "ellipsoid, m: gives heading, pitch and roll of each frame; needs no --tilt; without tilts the "
        "position of a frame is null",
    )
    parser.add_argument(
        "--geodetic",
        action="store_true",
        help="--site is on WGS 84, as a map or a receiver has it",
    )
    parser.add_argument(
        "--site-stddev",
        type=number(0, 100_000),
        metavar="M",
        help="error of --site to the east and to the north (0; 31 m are 1 arcsec)",
    )


def place_of(args: argparse.Namespace, vertical: Vertical) -> Place | None:
    """The place of --site, None without it; InstrumentError for bad options, PlaceError for an impossible place.

    vertical: the deflection by the other options.
    """
    if args.site is None:
        if args.geodetic or args.site_stddev is not None:
            raise InstrumentError("--geodetic and --site-stddev are for --site: give it too")
        return None
    if len(args.site) not in (2, 3):
        raise InstrumentError(
            f"--site has {len(args.site)} numbers: give latitude, longitude and optionally the height in m, "
            f"after the frames"
        )
    if args.self_calibrate:
        raise InstrumentError(
            "--self-calibrate is for an unknown place: leave out --site, or find A3 by starpos calibrate --site"
        )
    if args.pointings is not None:
        raise InstrumentError("--site is for frames, and --pointings has none: leave out one of them")
    if len(args.site) == 3 and isinstance(vertical, AtHeight):
        if args.altitude_m is not None:
            raise InstrumentError("--site has a height, and --altitude-m another: give one")
        vertical = replace(vertical, height_m=args.site[2])
    covariance = np.eye(2) * (args.site_stddev or 0.0) ** 2
    make = Place.on_ellipsoid if args.geodetic else Place.by_gravity
    latitude_deg, longitude_deg, *_ = args.site
    return make(latitude_deg, longitude_deg, vertical, covariance)

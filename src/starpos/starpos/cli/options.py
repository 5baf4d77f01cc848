# SPDX-License-Identifier: Apache-2.0
"""Options shared by several commands: frames, instrument, air, deflection, known place; the objects made from them."""

import argparse
from dataclasses import replace

import numpy as np

from starpos.cli import console
from starpos.earth import geoid
from starpos.earth.place import Place
from starpos.earth.refraction import Atmosphere
from starpos.earth.vertical import UNKNOWN_STDDEV_ARCSEC, AtHeight, Deflection, Vertical
from starpos.errors import InstrumentError
from starpos.fix.directions import OPTICAL_AXIS
from starpos.frames.exposure import Shutter
from starpos.frames.frame import Frame, Stars
from starpos.instrument import instrument, instrument_file, platepar, sensors
from starpos.instrument.camera import PLUMB_BOB, Camera
from starpos.sky.bodies import ERFA, JplKernel, SolarSystem


def check_frames(args: argparse.Namespace) -> None:
    """Raise InstrumentError unless there are either frames or --pointings."""
    if bool(args.frames) == (args.pointings is not None):
        raise InstrumentError("give either frames or --pointings CSV" + (", not both" if args.frames else ""))


def has_own_level(args: argparse.Namespace) -> bool:
    """Whether --instrument is the file of a camera fixed to the ground; InstrumentError if there is a --tilt too."""
    if args.instrument is None:
        return False
    if _instrument_in_file(args).vertical is None:
        return False
    if args.tilt is not None or getattr(args, "self_calibrate", False):
        raise InstrumentError(
            f"{args.instrument} describes a camera fixed to the ground, without an inclinometer: leave out --tilt "
            "and --self-calibrate, or give another instrument file"
        )
    return True


def fill_site(args: argparse.Namespace) -> None:
    """Take the place that a file of RMS given as --instrument states, on WGS 84; --site and --tilt come first."""
    if (
        not platepar.is_rms(args.instrument)
        or getattr(args, "site", ()) is not None
        or getattr(args, "tilt", None)
    ):
        return
    station = platepar.read(args.instrument)
    args.site, args.geodetic = [station.latitude_deg, station.longitude_deg], True


def turn_of(args: argparse.Namespace) -> float:
    """Sigma in deg of A3's turn about the plumb line, from --turn-stddev."""
    return 180.0 if args.turn_stddev is None else args.turn_stddev


def camera_of(args: argparse.Namespace) -> Camera:
    """An ideal camera from --focal-mm, --pixel-um and --size."""
    width, height = args.size
    return Camera.from_focal(width, height, instrument.focal_px_of(args.focal_mm, args.pixel_um))


def ephemeris_of(args: argparse.Namespace) -> SolarSystem:
    """The kernel of --ephemeris, or ERFA's series; InstrumentError if it cannot be read."""
    return ERFA if args.ephemeris is None else JplKernel(args.ephemeris)


def atmosphere_of(args: argparse.Namespace) -> Atmosphere:
    """The air from the options, as far as they give it; `args.air`: from a field report."""
    if (stated := getattr(args, "air", None)) is not None:
        return stated
    pressure_pa = None if args.pressure_hpa is None else args.pressure_hpa * 100
    return Atmosphere.measured(pressure_pa, args.temperature_c, args.humidity, args.wavelength_um)


def instrument_of(args: argparse.Namespace, first: Frame | Stars | None) -> instrument.Instrument:
    """The instrument from --instrument, or from --focal-mm and --pixel-um, or from the first frame's header.

    Raises InstrumentError if the options do not fit together or there is no focal length.
    """
    misalignment = getattr(args, "misalignment", None)
    stddev = getattr(args, "misalignment_stddev", None)
    model = getattr(args, "inclinometer", None)
    lens = getattr(args, "lens", PLUMB_BOB)
    flat = (args.focal_mm, args.pixel_um, misalignment, stddev, model) != (None,) * 5 or lens != PLUMB_BOB
    if getattr(args, "instrument", None) is not None:
        if flat:
            raise InstrumentError(
                "--instrument holds focal length, lens, misalignment and the inclinometer: give either it or the options"
            )
        return _with_times(_instrument_in_file(args), args)
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


def _instrument_in_file(args: argparse.Namespace) -> instrument.Instrument:
    """The instrument of --instrument; pointings need no camera."""
    return instrument_file.read(args.instrument, needs_camera=getattr(args, "pointings", None) is None)


def _with_times(known: instrument.Instrument, args: argparse.Namespace) -> instrument.Instrument:
    """The instrument with its clock's error from --clock-stddev and its shutter from --readout, as far as given."""
    stddev, readout = getattr(args, "clock_stddev", None), getattr(args, "readout", None)
    if stddev is not None:
        known = replace(known, clock_stddev_s=stddev)
    return known if readout is None else replace(known, shutter=Shutter(*readout))


# sigma of a deflection that is given by hand without one
GIVEN_STDDEV_ARCSEC = 1.0


def vertical_of(args: argparse.Namespace) -> Vertical:
    """The deflection that is given by hand or by a geoid; without either an unknown one.  Raises StarposError.

    A deflection given by hand holds at the instrument; others hold at the geoid, and plumb lines curve above it.
    """
    by_hand = args.xi, args.eta, args.deflection_stddev
    if args.geoid is not None:
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


def tell_unknown(args: argparse.Namespace, deflection: Deflection) -> None:
    """Complain if the geoid that was given has no data at the place."""
    if args.geoid is not None and not deflection.known:
        stddev = deflection.stddev_arcsec
        console.complain(
            f"{args.geoid}: no data around this place; the deflection is unknown, {stddev:.2g} arcsec"
        )


def axes_of(args: argparse.Namespace) -> dict[str, tuple[float, ...]]:
    """Names and unit vectors in C of the optical axis and of each --axis; raises InstrumentError."""
    axes: dict[str, tuple[float, ...]] = {"optical axis": OPTICAL_AXIS}
    for name, *xyz in args.axis:
        try:
            v = np.array(xyz, float)
        except ValueError:
            v = np.zeros(3)
        if not (np.isfinite(v).all() and np.abs(v).max() > 0):
            raise InstrumentError(f"--axis {name} {' '.join(xyz)}: give a name and three numbers, not all 0")
        axes[name] = tuple((v / np.linalg.norm(v)).tolist())
    return axes


def camera_place_of(args: argparse.Namespace) -> Place:
    """The place of --site, which the command needs; errors as of `place_of`."""
    place = place_of(args, vertical_of(args))
    if place is None:
        raise InstrumentError(f"{args.command} needs the place of the camera: give --site LAT LON")
    return place


def place_of(args: argparse.Namespace, vertical: Vertical) -> Place | None:
    """The place of --site, None without it; InstrumentError for bad options, PlaceError for an impossible place.

    vertical: the deflection by the other options.
    """
    if args.site is None:
        return None
    if len(args.site) not in (2, 3):
        raise InstrumentError(
            f"--site has {len(args.site)} numbers: give latitude, longitude and optionally the height in m, "
            f"after the frames"
        )
    if len(args.site) == 3 and isinstance(vertical, AtHeight):
        if args.altitude_m is not None:
            raise InstrumentError("--site has a height, and --altitude-m another: give one")
        vertical = replace(vertical, height_m=args.site[2])
    covariance = np.eye(2) * (getattr(args, "site_stddev", None) or 0.0) ** 2
    make = Place.on_ellipsoid if args.geodetic else Place.by_gravity
    latitude_deg, longitude_deg, *_ = args.site
    return make(latitude_deg, longitude_deg, vertical, covariance)

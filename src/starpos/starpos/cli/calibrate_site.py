# SPDX-License-Identifier: Apache-2.0
"""`starpos calibrate --site`: A3 at a known place, written into an instrument file."""

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from starpos.calibration.fixed_camera import calibrate_fixed
from starpos.calibration.misalignment import NOTHING_KNOWN, Calibrated, Known, calibrate_at
from starpos.calibration.unknown import FIND_TURN, at_another_lean, may_turn
from starpos.cli import console, options
from starpos.cli.overwriting import save_instrument
from starpos.cli.vertical import add_vertical, vertical_of
from starpos.earth.vertical import astronomic
from starpos.errors import InstrumentError, StarposError
from starpos.fix.solver import Solver
from starpos.frames.pointings import Pointing
from starpos.frames.stars import Stars
from starpos.instrument import instrument_update
from starpos.instrument.camera_vertical import MAX_SAG_ARCSEC, SAG_ARCSEC_PER_SQRT_HOUR
from starpos.instrument.inclinometer import up_of
from starpos.instrument.instrument import Calibration, Instrument
from starpos.instrument.tilt_log import TiltLog
from starpos.night.elevations import axis_of, circles_of
from starpos.night.remarks import of_inclinometer
from starpos.sky import catalogue
from starpos.sky.site import Site
from starpos.units import ARCSEC


def define(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--site",
        type=float,
        nargs=2,
        metavar=("LAT", "LON"),
        help="find A3 at this place, deg, by gravity (as a fix has them); needs -o, and --tilt or --fixed",
    )
    parser.add_argument(
        "--fixed",
        action="store_true",
        help="a camera fixed to the ground, without an inclinometer: its pose at --site serves as its "
        "vertical, and `solve` with the file that -o writes needs no --tilt; it gives position and "
        "heading as long as the stars show the camera in that pose; once the camera has moved, it says "
        "so and gives no position",
    )
    parser.add_argument(
        "--sag",
        type=options.number(0, MAX_SAG_ARCSEC),
        metavar="ARCSEC",
        help="how far a --fixed camera sags in an hour, 1 sigma about each axis; it grows with the root of the time "
        f"({SAG_ARCSEC_PER_SQRT_HOUR:g}, 300 m; after a week 13 times as much)",
    )
    parser.add_argument(
        "--geodetic",
        action="store_true",
        help="--site is on WGS 84, as a map or a receiver gives it: the deflection of the vertical is added",
    )
    add_vertical(parser)
    options.add_turn(parser)
    parser.add_argument(
        "-o",
        "--output",
        metavar="OUT",
        help="write A3 into an instrument file (YAML); one that is there keeps its other keys",
    )
    parser.add_argument(
        "--valid-days",
        type=options.number(0.01, 1e5),
        metavar="DAYS",
        help="after which the calibration is refused (365)",
    )


def check(args: argparse.Namespace) -> None:
    """Raise InstrumentError for options that do not fit together."""
    deflection = (args.xi, args.eta, args.deflection_stddev, args.geoid, args.altitude_m) != (None,) * 5
    if args.site is None:
        if (
            deflection
            or args.geodetic
            or args.fixed
            or (args.output, args.valid_days, args.turn_stddev, args.sag) != (None,) * 4
        ):
            raise InstrumentError(
                "-o, --fixed, --sag, --geodetic, --turn-stddev, --valid-days and the deflection are for a "
                "calibration at a known place: give --site LAT LON"
            )
        return
    if deflection and not args.geodetic:
        raise InstrumentError(
            "--xi, --eta, --deflection-stddev, --geoid and --altitude-m are of a place on WGS 84: say --geodetic, or "
            "leave them out"
        )
    if args.fixed:
        if (args.tilt, args.misalignment, args.turn_stddev, args.inclinometer) != (None,) * 4:
            raise InstrumentError(
                "--fixed is for a camera without an inclinometer: leave out --tilt, --misalignment, "
                "--turn-stddev and "
                "--inclinometer"
            )
    elif args.sag is not None:
        raise InstrumentError("--sag is for a camera fixed to the ground: give --fixed too")
    if args.output is None or (args.tilt is None and not args.fixed):
        raise InstrumentError(
            "--site needs the tilts and a file to write: give --tilt CSV and -o INSTRUMENT.yaml (or --fixed in place of "
            "--tilt)"
        )
    latitude, longitude = args.site
    if not (abs(latitude) <= 90 and abs(longitude) <= 360):
        raise InstrumentError(f"--site {latitude:g} {longitude:g}: give latitude and longitude in deg")


def check_output(args: argparse.Namespace, instrument: Instrument) -> None:
    """Raise InstrumentError if the file of -o exists and describes another instrument."""
    if args.site is not None:
        instrument_update.check_fits(
            Path(args.output), instrument, fixed=args.fixed, camera_found=args.camera is not None
        )


def run(
    args: argparse.Namespace,
    frames: Sequence[Stars | Pointing],
    instrument: Instrument,
    tilts: TiltLog | None,
    known: Known = NOTHING_KNOWN,
) -> None:
    """Find A3, or the vertical of a fixed camera, write and print it; raises FixError if the frames do not determine it.

    known: identifications of the frames so far.
    """
    solver = Solver(instrument, catalogue.load_catalogue(), options.atmosphere_of(args))
    (site, stddev_arcsec), bar = _site(args), console.ProgressBar()
    if tilts is None:
        sag = SAG_ARCSEC_PER_SQRT_HOUR if args.sag is None else args.sag
        found = calibrate_fixed(solver, frames, site, stddev_arcsec, sag, bar, known)
    elif instrument.vertical is not None:
        raise InstrumentError(
            f"{args.instrument} describes a camera fixed to the ground: give --fixed, or another instrument "
            f"file"
        )
    else:
        found = calibrate_at(solver, frames, tilts, site, stddev_arcsec, options.turn_of(args), bar, known)
        for remark in of_inclinometer(instrument):
            console.complain("calibrate", remark)
    for solution in found.solutions:
        if solution.fix is None:
            console.complain("calibrate", f"left out: {solution.message}")
    if found.beyond:
        console.complain("calibrate", found.beyond)
    calibration = found.instrument.calibration
    if args.valid_days is not None:
        calibration = replace(calibration, valid_days=args.valid_days)
    found = replace(found, instrument=replace(found.instrument, calibration=calibration))
    about = _about(found, site)
    if args.misalignment is not None:
        about += _against(instrument.calibration, calibration)
    save_instrument("calibrate", args.output, found.instrument, about, camera_found=args.camera is not None)
    if args.json:
        console.print_json(_json_of(found, args.output))
    else:
        print(about, end="")


def run_elevations(
    args: argparse.Namespace, pointings: Sequence[Pointing], instrument: Instrument, tilts: TiltLog
) -> None:
    """Find A3's axis from pointings without a roll, write and print it; raises FixError if they do not determine it."""
    solver = Solver(instrument, catalogue.load_catalogue(), options.atmosphere_of(args))
    for row in circles_of(solver, pointings, tilts):
        if isinstance(row, StarposError):
            console.complain("calibrate", f"left out: {row}")
    site, stddev_arcsec = _site(args)
    found = axis_of(solver, pointings, tilts, site=site, site_stddev_arcsec=stddev_arcsec)
    for remark in of_inclinometer(instrument):
        console.complain("calibrate", remark)
    calibration = found.calibration(instrument.calibration, options.turn_of(args))
    if args.valid_days is not None:
        calibration = replace(calibration, valid_days=args.valid_days)
    about = (
        f"A3 of {calibration.frames} elevations in {found.directions} directions at {site.latitude_deg:+.6f} "
        f"{site.longitude_deg:+.6f} (by gravity): "
        "{:.5f} {:.5f} {:.5f} deg\n".format(*calibration.misalignment_deg)
        + f"the frame's centre in the inclinometer is known to {found.stddev_arcsec:.2f} arcsec; elevations "
        f"alone do not determine the turn about it, which does not matter for pointings without a roll\n"
    )
    whole = replace(instrument, calibration=calibration)
    save_instrument("calibrate", args.output, whole, about)
    if args.json:
        console.print_json(_json_of(Calibrated(whole, found.stddev_arcsec, ()), args.output))
    else:
        print(about, end="")


def _site(args: argparse.Namespace) -> tuple[Site, float]:
    """The astronomic place, and its sigma in arcsec."""
    if not args.geodetic:
        return Site(*args.site), 0.0
    latitude, longitude = np.radians(args.site).tolist()
    d = vertical_of(args).at(latitude, longitude)
    return Site(*np.degrees(astronomic(latitude, longitude, d)).tolist()), d.stddev_arcsec


def _about(found: Calibrated, site: Site) -> str:
    c = found.instrument.calibration
    if found.instrument.vertical is not None:
        sag = found.instrument.inclinometer.drift_rad_per_sqrt_hour / ARCSEC
        return (
            f"the vertical of a fixed camera of {c.frames} frames at {site.latitude_deg:+.6f} {site.longitude_deg:+.6f} "
            f"(by gravity), known to {found.plumb_stddev_arcsec:.2f} arcsec, and {sag:g} arcsec of sag in an hour\n"
        )
    lines = [
        f"A3 of {c.frames} frames at {site.latitude_deg:+.6f} {site.longitude_deg:+.6f} (by gravity): "
        "{:.5f} {:.5f} {:.5f} deg".format(*c.misalignment_deg),
        f"the plumb line in the camera is known to {found.plumb_stddev_arcsec:.2f} arcsec; "
        + at_another_lean(c),
    ]
    if may_turn(c):
        lines.append(f"to find that turn as well, {FIND_TURN}")
    return "\n".join(lines) + "\n"


def _against(given: Calibration, found: Calibration) -> str:
    """A line on how far apart two A3 have the plumb line in the camera, at the lean of the calibration."""
    up = up_of(np.radians(found.tilt_deg))
    apart = np.degrees(np.arccos(np.clip(up @ found.a3 @ given.a3.T @ up, -1, 1)))
    return f"the --misalignment given has the plumb line {apart:.2g} deg from there: check the site if it cannot be\n"


def _json_of(found: Calibrated, path: str) -> dict:
    c = found.instrument.calibration
    return {
        "instrument": path,
        "misalignment_deg": c.misalignment_deg,
        "covariance_arcsec2": np.asarray(c.covariance_arcsec2),
        "plumb_stddev_arcsec": found.plumb_stddev_arcsec,
        "frames": c.frames,
    }

# SPDX-License-Identifier: Apache-2.0
"""The options for the deflection of the vertical."""

import argparse

from starpos.cli import console, options
from starpos.earth import geoid
from starpos.earth.vertical import UNKNOWN_STDDEV_ARCSEC, AtHeight, Deflection, Vertical
from starpos.errors import InstrumentError

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
        type=options.number(-1000, 100_000),
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

# SPDX-License-Identifier: Apache-2.0
"""The options for a known place, at which the stars alone determine heading, pitch and roll."""

import argparse
from dataclasses import replace

import numpy as np

from starpos.cli import options
from starpos.earth.known_place import KnownPlace
from starpos.earth.vertical import AtHeight, Vertical
from starpos.errors import InstrumentError


def add_site(parser: argparse.ArgumentParser) -> None:
    """Add the options that `place_of` reads."""
    parser.add_argument(
        "--site",
        type=float,
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
        type=options.number(0, 100_000),
        metavar="M",
        help="error of --site to the east and to the north (0; 31 m are 1 arcsec)",
    )


def place_of(args: argparse.Namespace, vertical: Vertical) -> KnownPlace | None:
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
    make = KnownPlace.on_ellipsoid if args.geodetic else KnownPlace.by_gravity
    latitude_deg, longitude_deg, *_ = args.site
    return make(latitude_deg, longitude_deg, vertical, covariance)

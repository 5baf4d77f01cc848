# SPDX-License-Identifier: Apache-2.0
"""`starpos solve --sights`: the place by a sextant's altitudes."""

import argparse

from starpos.averaging.sights import circle_of_sight, place_of_sights, read_sights
from starpos.cli import console, options
from starpos.cli.fix_output import tell_elevations
from starpos.cli.inputs import near_of
from starpos.errors import InstrumentError, StarposError
from starpos.fix.circle import Circle
from starpos.instrument.instrument import UNKNOWN_CLOCK_S
from starpos.night.together import Together
from starpos.sky.catalogue import load_catalogue


def run(args: argparse.Namespace) -> int:
    """Solve the table of --sights; returns the exit status."""
    if args.frames:
        raise InstrumentError("give either frames or --sights CSV, not both")
    sights, near, vertical = read_sights(args.sights), near_of(args), options.vertical_of(args)
    clock_s = UNKNOWN_CLOCK_S if args.clock_stddev is None else args.clock_stddev
    catalogue, air = load_catalogue(), options.atmosphere_of(args)
    ephemeris = options.ephemeris_of(args)
    output = console.Output(args, "elevations")
    circles: list[Circle | StarposError] = []
    for sight in sights:
        try:
            circles.append(circle_of_sight(sight, catalogue, air, clock_s, ephemeris))
        except StarposError as error:
            circles.append(error)
    whole = Together()
    sound = [(s, c) for s, c in zip(sights, circles, strict=True) if isinstance(c, Circle)]
    if sound:
        try:
            used, seen = zip(*sound, strict=True)
            whole = Together.by_circles(place_of_sights(used, seen, near and near.place), near)
        except StarposError as error:
            whole = Together(None, str(error))
    return tell_elevations(args, output, sights, circles, whole, vertical, near)

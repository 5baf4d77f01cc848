# SPDX-License-Identifier: Apache-2.0
"""`starpos solve --sights`: the place by a sextant's altitudes."""

import argparse

from starpos.averaging.sights import circle_of_sight, place_of_sights, read_sights
from starpos.cli import console, options
from starpos.cli.fix_output import COLUMNS, ELEVATIONS_HEAD, put_combined, put_elevation
from starpos.cli.inputs import near_of
from starpos.errors import InstrumentError, StarposError
from starpos.fix.solution import Status
from starpos.instrument.instrument import UNKNOWN_CLOCK_S
from starpos.night.remarks import doubts, of_average
from starpos.night.together import Gathered
from starpos.sky.catalogue import load_catalogue


def run(args: argparse.Namespace) -> int:
    """Solve the table of --sights; returns the exit status."""
    if args.frames:
        raise InstrumentError("give either frames or --sights CSV, not both")
    sights, near, vertical = read_sights(args.sights), near_of(args), options.vertical_of(args)
    clock_s = UNKNOWN_CLOCK_S if args.clock_stddev is None else args.clock_stddev
    catalogue, air = load_catalogue(), options.atmosphere_of(args)
    ephemeris = options.ephemeris_of(args)
    output, used, circles = console.Output(args, COLUMNS, ELEVATIONS_HEAD), [], []
    for sight in sights:
        try:
            circle = circle_of_sight(sight, catalogue, air, clock_s, ephemeris)
        except StarposError as error:
            console.complain(error)
            put_elevation(output, sight.source, sight.utc_unix_s, None, vertical, Status.BAD_INPUT.value)
            continue
        used.append(sight)
        circles.append(circle)
        put_elevation(output, sight.source, sight.utc_unix_s, circle.zenith_distance, vertical)
    if not circles:
        return console.NOTHING
    place, about = None, {}
    try:
        place = place_of_sights(used, circles, None if near is None else (near.latitude, near.longitude))
    except StarposError as error:
        console.complain(error)
    else:
        console.complain(*of_average(place), *doubts((), place, None, near))
        about = {} if near is None else {"km_from_near": near.km_from(place.latitude, place.longitude)}
    put_combined(output, None, place, Gathered(), vertical, about)
    return console.NOTHING if place is None else 0

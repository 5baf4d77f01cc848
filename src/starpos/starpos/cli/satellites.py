# SPDX-License-Identifier: Apache-2.0
"""`starpos satellites`: a place from satellites among the stars, without a level, and which hour shows most of them."""

import argparse
import math
import time
from functools import partial

import numpy as np

from starpos.cli import console, inputs, options
from starpos.earth.place import Place
from starpos.errors import SatelliteError
from starpos.fix.blind import SEARCH_S
from starpos.night.by_satellites import located, orbits_at, sighted
from starpos.night.reading import Each
from starpos.night.work import Solving
from starpos.satellites.elements import Orbit
from starpos.satellites.locating import SatelliteFix
from starpos.satellites.planning import HourOfSatellites, nights_hours
from starpos.satellites.trails import SatelliteTrail
from starpos.units import unix_of, utc_text

KM = 1000.0


def run(args: argparse.Namespace) -> int:
    if args.plan is not None:
        return plan(args)
    if not args.sightings or not args.elements:
        raise SatelliteError("give frames or sightings and --elements, or --plan LAT LON")
    complaints = console.FrameComplaints()
    trails, sights = sighted(args.sightings, partial(_look, args), console.complain, complaints)
    complaints.end()
    fix = located(
        trails,
        sights,
        args.elements,
        height_m=args.height,
        height_stddev_m=args.height_stddev,
        clock_stddev_s=args.clock_stddev,
        near=_near(args),
        newer_elements=args.newer_elements,
        say=console.complain,
    )
    if isinstance(fix, str):
        return _refused(args, fix)
    for k, trail in enumerate(trails):
        value = trail_json(trail, fix, k)
        console.tell(args, value, trail_line(value))
    headings = [
        {"file": name, "heading": np.degrees(heading), "sigma_heading_deg": np.degrees(sigma)}
        for name, heading, sigma in fix.headings
    ]
    lines = [f"{h['file']}: heading {h['heading']:.4f} +- {h['sigma_heading_deg']:.4f} deg" for h in headings]
    console.tell(
        args, {"combined": True} | fix_json(fix) | {"frames": headings}, "\n".join([*lines, fix.text])
    )
    return 0


def _refused(args: argparse.Namespace, why: str) -> int:
    console.complain(why)
    if args.json:
        console.print_json(
            {"combined": True, "latitude_geodetic": None, "longitude_geodetic": None, "status": why}
        )
    return 1


def _look(args: argparse.Namespace, frames: list[str]) -> tuple[Solving, Each]:
    read = inputs.reader_of(args)
    return inputs.identifying(args, frames, read, SEARCH_S), inputs.each_of(args, read, frames)


def _near(args: argparse.Namespace) -> Place | str | None:
    """The place of --near, or the file of --join; None without either."""
    if args.near is None:
        return args.join
    latitude, longitude, km = args.near
    if not (abs(latitude) <= 90 and abs(longitude) <= 360 and 0 < km < 20_000):
        raise SatelliteError("--near takes a latitude, a longitude (deg) and an error in km")
    return Place.on_ellipsoid(latitude, longitude, covariance=(km * KM) ** 2 * np.eye(2))


def trail_json(trail: SatelliteTrail, fix: SatelliteFix, k: int) -> dict:
    """A trail for --json."""
    orbit, row = fix.named[k], fix.adjusted[k]
    used = bool(row >= 0 and fix.adjustment.used[row])
    value = {
        "track": trail.track,
        "satellite": None if orbit is None else orbit.number,
        "name": None if orbit is None else orbit.name,
        "used": used,
        "age_days": None if orbit is None else orbit.age_days(float(trail.utc_unix_s[0])),
        "along_km": fix.adjustment.offset_m[row, 1] / KM if used else None,
        "across_km": fix.adjustment.offset_m[row, 2] / KM if used else None,
        "probability": fix.adjustment.probability[row] if used else None,
    }
    return value | ({"file": trail.file} if trail.file else {})


def trail_line(value: dict) -> str:
    """Return the same for people."""
    if value["satellite"] is None:
        return f"trail {value['track']}: no satellite of the orbits"
    head = f"trail {value['track']}: satellite {value['satellite']} {value['name']}".rstrip()
    head += f", elements of {value['age_days']:+.1f} days"
    if not value["used"]:
        return f"{head}: does not fit, not used"
    return f"{head}: {value['along_km']:+.2f} km along, {value['across_km']:+.2f} km across"


def fix_json(fix: SatelliteFix) -> dict:
    """The place for --json."""
    a = fix.adjustment
    return {
        "latitude_geodetic": np.degrees(fix.latitude),
        "longitude_geodetic": np.degrees(fix.longitude),
        "height_m": fix.height_m,
        "covariance": fix.covariance,
        "clock_offset_s": fix.clock_s,
        "clock_stddev_s": fix.clock_stddev_s,
        "satellites": fix.satellites,
        "trails_used": int(a.used.sum()),
        "chi2": a.chi2,
        "degrees": a.degrees,
        "status": "ok"
        if a.scale == 1
        else f"ok; the residuals are larger than stated, the covariance is {a.scale:.1f} times",
    }


def plan(args: argparse.Namespace) -> int:
    """Print the dark hours of the coming 24, and which of them shows most."""
    begin = time.time() if args.at is None else unix_of(args.at)
    orbits: list[Orbit] = []
    if args.elements:
        orbits = orbits_at(begin, args.elements, args.newer_elements, console.complain)
    lens = None
    if args.size is not None:
        focal_px = options.instrument_of(args, None).focal_px
        width, height = (2 * math.degrees(math.atan(side / 2 / focal_px)) for side in args.size)
        lens = width, height
    latitude, longitude = args.plan
    if not (abs(latitude) <= 90 and abs(longitude) <= 360):
        raise SatelliteError(f"--plan {latitude:g} {longitude:g}: give latitude and longitude in deg")
    hours = nights_hours(latitude, longitude, begin, orbits, least_deg=args.min_altitude, lens_deg=lens)
    if not hours:
        console.complain("the Sun does not sink 6 deg below the horizon there in these 24 hours")
        return 1
    most = max(hours, key=lambda h: h.at_once if lens is None else h.in_lens)
    for hour in hours:
        best = bool(orbits) and hour is most
        console.tell(
            args, plan_json(hour, lens is not None) | {"best": best}, plan_line(hour, lens is not None, best)
        )
    return 0


def plan_json(hour: HourOfSatellites, lens: bool) -> dict:
    """An hour for --json."""
    return {
        "utc": utc_text(hour.utc_unix_s),
        "sun_deg": hour.sun_deg,
        "lit_from_km": hour.lit_from_km,
        "satellites": hour.numbers,
        "at_once": hour.at_once,
        "in_lens": hour.in_lens if lens else None,
        "azimuth": hour.towards[0] if lens else None,
        "altitude": hour.towards[1] if lens else None,
    }


def plan_line(hour: HourOfSatellites, lens: bool, best: bool) -> str:
    """Return the same for people."""
    line = (
        f"{utc_text(hour.utc_unix_s)} Sun {hour.sun_deg[0]:.0f} to {hour.sun_deg[1]:.0f} deg, overhead in sunlight from "
        f"{hour.lit_from_km:.0f} km: {len(hour.numbers)} satellites, {hour.at_once:.1f} at a time"
    )
    if lens:
        line += f", {hour.in_lens:.2f} in the lens at azimuth {hour.towards[0]:.0f} altitude {hour.towards[1]:.0f}"
    return f"{line}, the best hour" if best else line

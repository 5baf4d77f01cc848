# SPDX-License-Identifier: Apache-2.0
"""`starpos satellites`: a place from satellites among the stars, without a level, and which hour shows most of them."""

import argparse
import json
import math
import time
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from starpos.cli import console, inputs, options
from starpos.earth.place import Place
from starpos.earth.refraction import Atmosphere
from starpos.earth.vertical import Deflection
from starpos.errors import FrameError, SatelliteError, StarposError
from starpos.files import read_regular
from starpos.fix.blind import SEARCH_S
from starpos.fix.searching import Sight
from starpos.fix.solution import Solution
from starpos.fix.solver import Solver
from starpos.gnss.receiver import gnss_place, read_gnss_csv
from starpos.night.work import trails_seen
from starpos.satellites.adjustment import KnownBefore
from starpos.satellites.elements import Orbit, chosen, read_orbits
from starpos.satellites.locating import SatelliteFix, locate
from starpos.satellites.planning import HourOfSatellites, nights_hours
from starpos.satellites.sightings import read_iod, read_sightings
from starpos.satellites.trails import SatelliteTrail
from starpos.sky import catalogue
from starpos.units import unix_of, utc_text

# of a height that is stated without an error
HEIGHT_STDDEV_M = 50.0
KM = 1000.0
# other files are frames
TABLES = ".csv", ".iod", ".txt"
MOST_JSON_BYTES = 300_000_000


def run(args: argparse.Namespace) -> int:
    if args.plan is not None:
        return plan(args)
    if not args.sightings or not args.elements:
        raise SatelliteError("give frames or sightings and --elements, or --plan LAT LON")
    frames = [path for path in args.sightings if Path(path).suffix.lower() not in TABLES]
    trails = [trail for path in args.sightings if path not in frames for trail in _read(path)]
    sights = _look(args, frames, trails) if frames else {}
    if not trails:
        return _refused(args, f"none of {len(frames)} frames shows an end of a trail: give more frames")
    begin = float(min(t.utc_unix_s.min() for t in trails))
    usable, about = chosen(_orbits(args.elements), begin, newer=args.newer_elements)
    console.complain(*about)
    prior = _prior(args, begin)
    try:
        fix = locate(trails, usable, prior)
    except SatelliteError as e:
        return _refused(args, str(e))
    for k, trail in enumerate(trails):
        value = trail_json(trail, fix, k)
        console.tell(args, value, trail_line(value))
    headings = [h for name, sight in sights.items() if (h := heading_json(name, sight, fix)) is not None]
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


def _orbits(paths: Sequence[str]) -> list[Orbit]:
    orbits = []
    for path in paths:
        found, about = read_orbits(path)
        orbits += found
        console.complain(*about)
    return orbits


def _read(path: str) -> list[SatelliteTrail]:
    if Path(path).suffix.lower() == ".csv":
        return read_sightings(path)
    trails, about = read_iod(path)
    console.complain(*about)
    return trails


def _look(args: argparse.Namespace, frames: list[str], trails: list[SatelliteTrail]) -> dict[str, Sight]:
    """The frames that were identified, by name; their trails are added, numbered on, and what is left out is said."""
    number, sights = 1 + max((trail.track for trail in trails), default=-1), {}
    complaints, read = console.FrameComplaints(), inputs.reader_of(args)
    work = partial(read.on, partial(trails_seen, inputs.identifying(args, frames, read, SEARCH_S)))
    for path, answer in inputs.worked(args, work, frames):
        if isinstance(answer, FrameError):
            complaints(path, str(answer))
        elif isinstance(answer, Solution):
            complaints(path, answer.message)
        else:
            sights[path], found, left_out = answer
            if left_out:
                complaints(path, left_out)
            trails += [replace(t, track=number + k, file=path) for k, t in enumerate(found)]
            number += len(found)
    complaints.end()
    return sights


def _prior(args: argparse.Namespace, utc_unix_s: float) -> KnownBefore:
    height = math.nan if args.height is None else args.height
    prior = KnownBefore.at_height(height, HEIGHT_STDDEV_M, args.clock_stddev)
    if args.height_stddev is not None:
        prior = prior._replace(height_stddev_m=args.height_stddev)
    if args.near is not None:
        latitude, longitude, km = args.near
        if not (abs(latitude) <= 90 and abs(longitude) <= 360 and 0 < km < 20_000):
            raise SatelliteError("--near takes a latitude, a longitude (deg) and an error in km")
        near = Place.on_ellipsoid(latitude, longitude, covariance=(km * KM) ** 2 * np.eye(2))
        return prior._replace(near=near)
    return prior if args.join is None else prior._replace(near=_joined(args.join, utc_unix_s))


def _joined(path: str, utc_unix_s: float) -> Place:
    """The place of what `starpos solve --json` printed, or of GNSS."""
    if Path(path).suffix.lower() == ".csv":
        track, faults = read_gnss_csv(path)
        console.complain(*faults)
        if (place := track.at(utc_unix_s)) is None:
            raise SatelliteError(f"{path}: no GNSS place at {utc_text(utc_unix_s)}, of the first trail")
        return place
    try:
        text = read_regular(path, MOST_JSON_BYTES).decode()
        rows = [json.loads(line) for line in text.splitlines() if line.startswith("{")]
        row = next(
            row for row in reversed(rows) if row.get("combined") and row.get("latitude_geodetic") is not None
        )
        covariance = np.array(row["covariance_geodetic"], float)[:2, :2]
        latitude, longitude = float(row["latitude_geodetic"]), float(row["longitude_geodetic"])
    except (OSError, ValueError, KeyError, StopIteration, TypeError, IndexError):
        raise SatelliteError(
            f"{path}: no place in it: give what `starpos solve --json` printed, or a receiver's CSV as solve --gnss"
        ) from None
    if not (np.isfinite(covariance).all() and np.linalg.eigvalsh(covariance)[0] > 0):
        raise SatelliteError(f"{path}: the covariance of its place is impossible")
    return Place.on_ellipsoid(latitude, longitude, covariance=covariance)


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


def heading_json(name: str, sight: Sight, fix: SatelliteFix) -> dict | None:
    """Where a frame's camera looks from that place, from geodetic north; None where that is not known."""
    if sight.instrument is None or sight.found is None or sight.stars.mid_unix_s is None:
        return None
    place = gnss_place(sight.stars.mid_unix_s, fix.latitude, fix.longitude, fix.covariance[:2, :2])
    solver = Solver(sight.instrument, catalogue.load_catalogue(), Atmosphere.measured(None, None))
    try:
        link = solver.attitude_at(sight.stars, sight.found, place.deflected(Deflection())).ellipsoid
    except StarposError as e:
        console.complain(f"{name}: no heading: {e}")
        return None
    sigma = np.degrees(np.sqrt(link.angles_covariance[0, 0]))
    return {"file": name, "heading": np.degrees(link.heading), "sigma_heading_deg": sigma}


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
        orbits, about = chosen(_orbits(args.elements), begin, newer=args.newer_elements)
        console.complain(*about)
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

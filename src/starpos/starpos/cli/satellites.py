# SPDX-License-Identifier: Apache-2.0
"""`starpos satellites`: a place from satellites among the stars, without a level."""

import argparse
import math
from dataclasses import replace
from pathlib import Path

import numpy as np

from starpos.cli import console, inputs
from starpos.earth.gravity import itrs_place
from starpos.errors import FrameError, SatelliteError
from starpos.fix.blind import SEARCH_S
from starpos.fix.solution import Solution
from starpos.night.work import OnFile, TrailSighted
from starpos.satellites.adjustment import KnownBefore
from starpos.satellites.elements import chosen, read_orbits
from starpos.satellites.locating import SatelliteFix, locate
from starpos.satellites.sightings import read_iod, read_sightings
from starpos.satellites.trails import SatelliteTrail

# without a height stated: any inhabited one
UNKNOWN_HEIGHT_M, UNKNOWN_HEIGHT_STDDEV_M = 500.0, 700.0
HEIGHT_STDDEV_M = 50.0
KM = 1000.0
# other files are frames
TABLES = ".csv", ".iod", ".txt"


def run(args: argparse.Namespace) -> int:
    trails: list[SatelliteTrail] = []
    frames = [path for path in args.sightings if Path(path).suffix.lower() not in TABLES]
    for path in args.sightings:
        trails += [] if path in frames else _read(path)
    if frames:
        trails += _on_frames(args, frames, 1 + max((trail.track for trail in trails), default=-1))
    if not trails:
        return _refused(
            args, f"none of {len(frames)} frames shows a trail with both of its ends: give more frames"
        )
    orbits = []
    for path in args.elements:
        found, about = read_orbits(path)
        orbits += found
        for sentence in about:
            console.complain("satellites", sentence)
    begin = float(min(t.utc_unix_s.min() for t in trails))
    usable, about = chosen(orbits, begin, newer=args.newer_elements)
    for sentence in about:
        console.complain("satellites", sentence)
    try:
        fix = locate(trails, usable, _prior(args))
    except SatelliteError as e:
        return _refused(args, str(e))
    for k, trail in enumerate(trails):
        value = trail_json(trail, fix, k)
        _put(args, value, trail_line(value))
    value = fix_json(fix)
    _put(args, value, fix_line(value))
    return 0


def _refused(args: argparse.Namespace, why: str) -> int:
    console.complain("satellites", why)
    if args.json:
        console.print_json(
            {"combined": True, "latitude_geodetic": None, "longitude_geodetic": None, "status": why}
        )
    return 1


def _put(args: argparse.Namespace, value: dict, line: str) -> None:
    if args.json:
        console.print_json(value)
    else:
        print(line)


def _read(path: str) -> list[SatelliteTrail]:
    if Path(path).suffix.lower() == ".csv":
        return read_sightings(path)
    trails, about = read_iod(path)
    for sentence in about:
        console.complain("satellites", sentence)
    return trails


def _on_frames(args: argparse.Namespace, frames: list[str], first: int) -> list[SatelliteTrail]:
    """The trails on frames, numbered from `first` on; complains of frames without."""
    trails: list[SatelliteTrail] = []
    complaints, read = console.FrameComplaints("satellites"), inputs.reader_of(args)
    with inputs.workers_of(args, len(frames)) as workers:
        solving = inputs.identifying("satellites", args, frames, read, workers, SEARCH_S)
        work = OnFile(read, TrailSighted(solving))
        answers = inputs.watched(workers.map((work, path) for path in frames), len(frames))
        for path, found in zip(frames, answers, strict=True):
            if isinstance(found, FrameError):
                complaints(path, str(found))
            elif isinstance(found, Solution):
                complaints(path, found.message)
            else:
                trails += [replace(t, track=first + len(trails) + k, file=path) for k, t in enumerate(found)]
    complaints.end()
    return trails


def _prior(args: argparse.Namespace) -> KnownBefore:
    unknown = args.height is None
    height = UNKNOWN_HEIGHT_M if unknown else args.height
    stddev = args.height_stddev or (UNKNOWN_HEIGHT_STDDEV_M if unknown else HEIGHT_STDDEV_M)
    if args.near is None:
        return KnownBefore(height, stddev, args.clock_stddev)
    latitude, longitude, km = args.near
    if not (abs(latitude) <= 90 and abs(longitude) <= 360 and 0 < km < 20_000):
        raise SatelliteError("--near takes a latitude, a longitude (deg) and an error in km")
    place = itrs_place(math.radians(latitude), math.radians(longitude), height)
    return KnownBefore(height, stddev, args.clock_stddev, place, (km * KM) ** 2 * np.eye(2))


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
    if not value["used"]:
        return f"{head}, elements of {value['age_days']:+.1f} days: does not fit, not used"
    return (
        f"{head}, elements of {value['age_days']:+.1f} days: {value['along_km']:+.2f} km along, "
        f"{value['across_km']:+.2f} km across"
    )


def fix_json(fix: SatelliteFix) -> dict:
    """The place for --json."""
    a = fix.adjustment
    return {
        "combined": True,
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


def fix_line(value: dict) -> str:
    """Return the same for people."""
    east, north, up = np.sqrt(np.diag(value["covariance"]))
    return (
        f"place {value['latitude_geodetic']:.5f} {value['longitude_geodetic']:.5f} (WGS 84), {value['height_m']:.0f} m; "
        f"+- {east:.0f} m east, {north:.0f} m north, {up:.0f} m up; clock {value['clock_offset_s']:+.3f} s +- "
        f"{value['clock_stddev_s']:.3f}; {value['trails_used']} trails of {value['satellites']} satellites, chi-square "
        f"{value['chi2']:.1f} of {value['degrees']}: {value['status']}"
    )

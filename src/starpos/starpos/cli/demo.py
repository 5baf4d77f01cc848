# SPDX-License-Identifier: Apache-2.0
"""`starpos demo`: a drawn night at a place that is not printed, found by the commands that a person would type."""

import argparse
import json
import time
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from starpos.cli import console, inputs, main
from starpos.night.remarks import apart_m
from starpos.simulation.photographs import telephone_at, write_photographs
from starpos.sky.catalogue import load_catalogue
from starpos.units import DAY_S, utc_text

# the Sun is at least 20 deg below the horizon at their midnights
MAX_LATITUDE_DEG = 45.0
DRAWN = ("-n", "4", "--size", "2808", "1872")
# of the drawn instrument
A3 = ("--misalignment", "0", "0", "0", "--misalignment-stddev", "5")
KNOWN = (*A3, "--inclinometer", "sca100t_calibrated")


def run(args: argparse.Namespace) -> int:
    folder = Path(args.out)
    rng = np.random.default_rng(args.seed)
    place_deg = rng.uniform(-MAX_LATITUDE_DEG, MAX_LATITUDE_DEG), rng.uniform(-180, 180)
    call = (_photographs if args.photo else _night)(folder, place_deg, rng)
    if isinstance(call, int):
        return call
    places = folder / "place.geojson"
    calls = [("solve", *call, "-o", f"{places}")]
    if find_spec("matplotlib") is None:
        console.complain(f"without a page, which is drawn with matplotlib: {inputs.PIP}")
    else:
        calls.append(("report", *call, "-o", f"{folder / 'page.html'}"))
    for command in calls:
        print(f"\n$ starpos {' '.join(command)}", flush=True)
        if status := main(list(command)):
            return status
    (found,) = (
        f["properties"]
        for f in json.loads(places.read_text(encoding="utf-8"))["features"]
        if f["properties"].get("combined")
    )
    (north, east), (true_north, true_east) = np.radians([[found["latitude"], found["longitude"]], place_deg])
    off_m = apart_m((north, east), (true_north, true_east))
    off = f"{off_m:.0f} m" if off_m < 10e3 else f"{off_m / 1000:.0f} km"
    print(f"\nthe place that was hidden: {place_deg[0]:+.6f} {place_deg[1]:+.6f}, {off} from the one found")
    return 0


def _night(folder: Path, place_deg: tuple[float, float], rng: np.random.Generator) -> tuple[str, ...] | int:
    """Draw a night of frames and tilts; the arguments that solve it, or the exit status of a failure."""
    night = f"{folder / 'night'}"
    latitude, longitude = map(str, place_deg)
    place = ("--latitude", latitude, "--longitude", longitude, "--start", _midnight(place_deg[1]))
    print(
        f"$ starpos simulate {night} {' '.join(DRAWN)}    # at a place that is not printed, at midnight",
        flush=True,
    )
    if status := main(["simulate", night, *DRAWN, *place]):
        return status
    return night, *KNOWN


def _photographs(folder: Path, place_deg: tuple[float, float], rng: np.random.Generator) -> tuple[str, ...]:
    """Draw photographs of a telephone; their paths are all that solves them."""
    print("drawing photographs of a telephone at a place that is not printed, at midnight", flush=True)
    scene = telephone_at(*place_deg, azimuth_deg=rng.uniform(0, 360))
    start = _midnight(place_deg[1])
    written = write_photographs(
        folder / "photographs", scene, load_catalogue(), start, rng, console.ProgressBar()
    )
    return tuple(map(str, written))


def _midnight(longitude_deg: float) -> str:
    """UTC of the last local midnight."""
    late_s = longitude_deg / 360 * DAY_S
    return utc_text((time.time() + late_s) // DAY_S * DAY_S - late_s)

# SPDX-License-Identifier: Apache-2.0
"""`starpos demo`: a drawn night at a place that is not printed, found by the commands that a person would type."""

import argparse
import json
import time
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from starpos.cli import console, inputs, main
from starpos.night.opening import truth_in
from starpos.night.remarks import apart_m
from starpos.units import DAY_S, utc_text

# the Sun is at least 20 deg below the horizon at their midnights
MAX_LATITUDE_DEG = 45.0
DRAWN = ("-n", "4", "--size", "2808", "1872")
# of the drawn instrument
KNOWN = (
    "--misalignment",
    "0",
    "0",
    "0",
    "--misalignment-stddev",
    "5",
    "--inclinometer",
    "sca100t_calibrated",
)


def run(args: argparse.Namespace) -> int:
    folder = Path(args.out)
    night, places = f"{folder / 'night'}", f"{folder / 'place.geojson'}"
    rng = np.random.default_rng(args.seed)
    latitude, longitude = rng.uniform(-MAX_LATITUDE_DEG, MAX_LATITUDE_DEG), rng.uniform(-180, 180)
    place = ("--latitude", f"{latitude}", "--longitude", f"{longitude}", "--start", _midnight(longitude))
    print(
        f"$ starpos simulate {night} {' '.join(DRAWN)}    # at a place that is not printed, at midnight",
        flush=True,
    )
    if status := main(["simulate", night, *DRAWN, *place]):
        return status
    calls = [("solve", night, *KNOWN, "-o", places)]
    if find_spec("matplotlib") is None:
        console.complain("demo", f"without a page, which is drawn with matplotlib: {inputs.PIP}")
    else:
        calls.append(("report", night, *KNOWN, "-o", f"{folder / 'page.html'}"))
    for call in calls:
        print(f"\n$ starpos {' '.join(call)}", flush=True)
        if status := main(list(call)):
            return status
    truth = truth_in(Path(night))
    (found,) = (
        f
        for f in json.loads(Path(places).read_text(encoding="utf-8"))["features"]
        if f["properties"].get("combined")
    )
    at = np.radians([found["properties"][name] for name in ("latitude", "longitude")])
    assert truth is not None
    off_m = apart_m((at[0], at[1]), (truth.latitude, truth.longitude))
    where = np.degrees([truth.latitude, truth.longitude])
    print(f"\nthe place that was hidden: {where[0]:+.6f} {where[1]:+.6f}, {off_m:.0f} m from the one found")
    return 0


def _midnight(longitude_deg: float) -> str:
    """UTC of the last local midnight."""
    late_s = longitude_deg / 360 * DAY_S
    return utc_text((time.time() + late_s) // DAY_S * DAY_S - late_s)

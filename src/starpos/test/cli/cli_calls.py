# SPDX-License-Identifier: Apache-2.0
"""Calls of the command line, and what tests of it share."""

import json
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path

import pytest

from starpos_testing.command_line import A3, run
from starpos_testing.command_line import OPTICS as WIDE

SCHEMA = Path(__file__).resolve().parents[4] / "docs" / "reference" / "starpos.schema.json"
# the same, with an A3 that is known
KNOWN = (*WIDE, *A3)
PLACE = {"latitude": 47.3, "longitude": -122.8}
AIR = ("--pressure-hpa", "1000", "--temperature-c", "5")
SOLVE_KEYS = {"utc", "latitude", "longitude", "heading", "latitude_geodetic", "longitude_geodetic",
              "sigma_east_m", "sigma_north_m", "sigma_heading_deg", "covariance", "stars_detected", "stars_matched",
              "residual_arcsec", "log_odds", "status", "warnings"}  # fmt: skip
IDENTIFY_KEYS = {"file", "ra", "dec", "roll", "focal_px", "focal_stddev_px", "stars_detected", "stars_matched",
                 "residual_arcsec", "log_odds", "negative", "status", "warnings", "bright_explained", "bright_seen",
                 "cpu_ms"}  # fmt: skip


def objects(out):
    """The objects that --json printed, each as docs/reference/starpos.schema.json has it."""

    def no_constants(name):
        pytest.fail(f"{name} is no JSON")

    told = [json.loads(line, parse_constant=no_constants) for line in out.splitlines()]
    for line in told if find_spec("fastjsonschema") else ():
        promised()(line)
    return told


@lru_cache(maxsize=1)
def promised():
    """A validator that refuses any object outside the schema."""
    import fastjsonschema

    return fastjsonschema.compile(json.loads(SCHEMA.read_text()))


def solve(capsys, folder, *more, frames="frame_*.fits"):
    paths = sorted(folder.glob(frames))
    return run(capsys, "solve", *paths, "--tilt", folder / "tilt.csv", *AIR, *more)


def without_focal_length(path, folder):
    """A copy, in a folder, of a list of stars whose first line states no focal length."""
    head, rows = path.read_text().split("\n", 1)
    about = json.loads(head.lstrip("# "))
    del about["FOCALLEN"], about["XPIXSZ"]
    bare = folder / path.name
    bare.write_text(f"# {json.dumps(about)}\n{rows}")
    return bare

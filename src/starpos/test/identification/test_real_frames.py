# SPDX-License-Identifier: Apache-2.0
"""Real frames of three cameras against astrometry.net's solution of them; skips where the frames are not at hand."""

import csv

import erfa
import numpy as np
import pytest

from starpos.detection import detect
from starpos.detection.second_look import detect_dark_too, negative_of
from starpos.fix.solution import Status
from starpos.fix.solver import Solver
from starpos.frames.reading import read_frame
from starpos.instrument.instrument import Instrument

YEAR = {"openstartracker": 2017.4, "tetra3": 2019.6, "panoptes": 2016.7}


@pytest.fixture(
    scope="module", params=["openstartracker", "tetra3", "panoptes", "tetra3 negative", "panoptes negative"]
)
def answers(request, shared, catalogue):
    """What one camera saw: rows of the truth, the stars of each frame and what became of them, arcsec a pixel.

    With a word behind the camera's name the frames are negatives.
    """
    name, _, negative = request.param.partition(" ")
    with (shared / "real" / "truth.csv").open() as f:
        rows = [row for row in csv.DictReader(f) if row["set"] == name]
    scale = float(np.mean([float(row["scale_x"]) for row in rows if row["solved"] == "1"]))
    solver = Solver(Instrument(np.degrees(3600) / scale), catalogue)
    frames = [read_frame(shared / "real" / name / row["file"]) for row in rows]
    found = [detect_dark_too(negative_of(f)) if negative else detect(f) for f in frames]
    stars = [f.stars for f in found]
    return rows, stars, [solver.identify(s) for s in stars], scale


def solved(answers):
    rows, stars, solutions, scale = answers
    return [a for a in zip(rows, stars, solutions, [scale] * len(rows), strict=True) if a[0]["solved"] == "1"]


def test_all_are_identified_and_look_where_they_look(answers):
    for row, _, s, scale in solved(answers):
        assert s.ok, (row["file"], s.message)
        theirs = np.radians([float(row["ra_deg"]), float(row["dec_deg"])])
        off = erfa.seps(s.pointing.ra, s.pointing.dec, *theirs)
        assert np.degrees(off) * 3600 < max(20, scale), row["file"]
        assert s.pointing.mirrored == (row["parity"] == "mirrored")
        if not s.pointing.mirrored:
            roll = (np.degrees(s.pointing.roll) - float(row["pa_up_deg"]) + 180) % 360 - 180
            assert abs(roll) < 0.5, row["file"]


def rows_of(names, catalogue):
    """The catalogue's rows of stars of these names, as `Catalogue.labels` makes them."""
    rows = []
    for name in names:
        kind, numbers = name.split()
        wanted = np.array(numbers.split("-"), int)
        there = catalogue.hip == wanted if kind == "HIP" else (catalogue.tyc == wanted).all(1)
        rows.append(np.flatnonzero(there)[0])
    return np.array(rows)


def test_as_many_stars_as_astrometry_net_and_of_as_many_residuals_no_larger(answers, catalogue):
    """On the same terms: of as many, the brightest, after a fit of six parameters, as theirs is."""
    for row, stars, s, _ in solved(answers):
        n = int(row["nmatch"])
        assert len(s.names) >= n, row["file"]
        first = np.argsort(s.star)[:n]
        there = catalogue.directions(rows_of([s.names[k] for k in first], catalogue), YEAR[row["set"]])
        centre = erfa.s2c(s.pointing.ra, s.pointing.dec)
        east = erfa.s2c(s.pointing.ra + np.pi / 2, 0.0)
        plane = there @ np.stack([centre, east, np.cross(centre, east)], 1)
        design, seen = plane / plane[:, :1], np.stack([stars.x, stars.y], 1)[s.star[first]]
        residual = seen - design @ np.linalg.lstsq(design, seen, rcond=None)[0]
        # Theirs is rounded.
        assert np.sqrt(np.mean(residual**2)) < float(row["rms_px"]) + 0.005, row["file"]


# The others have none.
@pytest.mark.parametrize("answers", ["openstartracker"], indirect=True)
def test_nothing_is_invented_for_the_rest(answers):
    """What astrometry.net could not solve is refused, or answered with stars as bright as they should be."""
    rows, _, solutions, _ = answers
    for row, s in zip(rows, solutions, strict=True):
        if row["solved"] == "0" and s.status is not Status.NOT_IDENTIFIED:
            # the brighter a detection, the brighter its star
            magnitudes = s.magnitudes[np.argsort(s.star)]
            assert np.corrcoef(np.arange(len(magnitudes)), magnitudes)[0, 1] > 0.75, row["file"]
            assert s.pointing.log_odds > np.log(1e9)

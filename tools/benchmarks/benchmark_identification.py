# SPDX-License-Identifier: Apache-2.0
"""Table of starpos and its peers on the same random fields, in one run.

`benchmark_identification.py [--fields N] [--seed S] [--false K ...] [--index FOLDER]`.  Peers run where they can be
imported (`pip install cedar-solve astrometry`): cedar-solve with a database made here from this program's catalogue for
this field of view (five minutes), kept in the cache; astrometry.net's engine with FOLDER's index files
(its figures are those of these files: `build-astrometry-index -P 7 .. 10 -n 30` of a V < 9.5 list finds 97 to 98 %).
Every program gets the focal length to 3 %, and the stars in order of brightness; all programs get each field.
"""

import argparse
import importlib.util
import logging
import math
import sys
import time
from itertools import islice
from pathlib import Path

import numpy as np

from starpos import table_cache
from starpos.cli.common import ProgressBar
from starpos.cli.montecarlo import looking
from starpos.fix.solver import Solver
from starpos.instrument.camera import Camera
from starpos.instrument.instrument import Instrument
from starpos.simulation import montecarlo_fields
from starpos.sky import catalogue

# The paper's camera.
CAMERA = Camera.from_focal(5616, 3744, 93750.0)
# A peer's catalogue is deeper by this much, because of the scatter of brightness.
LIMIT_MAG, DEEPER_MAG = 9.0, 0.5
SCALE_ERROR = 0.03
TIMEOUT_MS = 5000


class Absent(Exception):
    """A peer cannot take part; the text says why."""


def starpos(stars, args) -> montecarlo_fields.Answer:
    solver = Solver(Instrument(CAMERA.fx), stars, progress=ProgressBar())
    solver.prepare(CAMERA.width, CAMERA.height)
    return looking(solver)


def cedar_solve(stars, args) -> montecarlo_fields.Answer:
    if importlib.util.find_spec("tetra3") is None:
        raise Absent("not installed (pip install cedar-solve)")
    from tetra3 import Tetra3

    fov_deg = math.degrees(2 * math.atan(CAMERA.width / 2 / CAMERA.fx))
    limit = LIMIT_MAG + DEEPER_MAG
    database = table_cache.cache_folder() / f"cedar-{fov_deg:.2f}deg-{limit:g}mag-{stars.fingerprint}.npz"
    solver = Tetra3(load_database=None)
    logging.getLogger("tetra3.Tetra3").setLevel(logging.WARNING)
    if not database.exists():
        print(f"making cedar-solve's database {database} ...", file=sys.stderr)
        begin = time.monotonic()
        source = database.with_name("tyc_main.dat")
        write_tyc_main(stars, limit, source)
        solver.generate_database(
            max_fov=fov_deg,
            save_as=database,
            star_catalog=source,
            star_max_magnitude=limit,
            epoch_proper_motion=None,
        )
        source.unlink()
        print(
            f"... took {time.monotonic() - begin:.0f} s, {database.stat().st_size / 1e6:.0f} MB",
            file=sys.stderr,
        )
    solver.load_database(database)

    def answer(given):
        found = solver.solve_from_centroids(
            np.stack([given.y, given.x], 1), (given.height, given.width), fov_estimate=fov_deg,
            fov_max_error=SCALE_ERROR * fov_deg, solve_timeout=TIMEOUT_MS,
        )  # fmt: skip
        return None if found["RA"] is None else unit(found["RA"], found["Dec"])

    return answer


def write_tyc_main(stars, limit_mag: float, path: Path) -> None:
    """Make the columns that cedar-solve reads of the Tycho catalogue: identifier, V, J2000 place."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w") as f:
        for k in np.flatnonzero(stars.vmag_centi < 100 * limit_mag):
            row = [""] * 14
            row[1] = "{} {} {}".format(*stars.tyc[k])
            row[5] = f"{stars.vmag_centi[k] / 100:.2f}"
            row[8], row[9] = (f"{x / 3.6e6:.8f}" for x in (stars.ra_mas[k], stars.dec_mas[k]))
            f.write("|".join(row) + "\n")


def astrometry_net(stars, args) -> montecarlo_fields.Answer:
    if importlib.util.find_spec("astrometry") is None:
        raise Absent("not installed (pip install astrometry)")
    index = sorted(args.index.rglob("index-*.fits")) if args.index else []
    if not index:
        raise Absent("no index files (--index FOLDER)")
    import astrometry

    solver = astrometry.Solver(index)
    scale = CAMERA.scale_arcsec
    size = astrometry.SizeHint(scale * (1 - SCALE_ERROR), scale * (1 + SCALE_ERROR))
    # Rows run downwards, so for this engine a frame has flipped parity.
    settings = astrometry.SolutionParameters(
        sip_order=0, tune_up_logodds_threshold=None, parity=astrometry.Parity.FLIP,
        logodds_callback=lambda odds: astrometry.Action.STOP,
    )  # fmt: skip

    def answer(given):
        solution = solver.solve(np.stack([given.x, given.y], 1), size, None, settings)
        if not solution.has_match():
            return None
        wcs = {name: value for name, (value, _) in solution.best_match().wcs_fields.items()}
        x, y = (c + 1 - wcs[f"CRPIX{k}"] for k, c in enumerate(CAMERA.centre_px, 1))
        east, north = (math.radians(wcs[f"CD{k}_1"] * x + wcs[f"CD{k}_2"] * y) for k in (1, 2))
        v = unit(wcs["CRVAL1"], wcs["CRVAL2"])
        to_east = np.cross([0, 0, 1], v) / math.hypot(v[0], v[1])
        v = v + east * to_east + north * np.cross(v, to_east)
        return v / np.linalg.norm(v)

    return answer


def unit(ra_deg: float, dec_deg: float) -> np.ndarray:
    ra, dec = math.radians(ra_deg), math.radians(dec_deg)
    return np.array([math.cos(dec) * math.cos(ra), math.cos(dec) * math.sin(ra), math.sin(dec)])


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--fields", type=int, default=1000, metavar="N", help="of each kind (1000)")
    parser.add_argument("--seed", type=int, default=1, metavar="S", help="of the random numbers (1)")
    parser.add_argument(
        "--false", type=int, nargs="+", default=[0, 1, 2], metavar="K", help="false stars (0 1 2)"
    )
    parser.add_argument("--index", type=Path, metavar="FOLDER", help="astrometry.net's index files")
    args = parser.parse_args()
    # Otherwise the log of one peer would be timed as its work.
    logging.basicConfig(level=logging.WARNING)
    stars, answers = catalogue.load_catalogue(), {}
    for name, peer in (
        ("starpos", starpos),
        ("cedar-solve", cedar_solve),
        ("astrometry.net", astrometry_net),
    ):
        try:
            answers[name] = peer(stars, args)
        except Absent as reason:
            print(f"{name}: skipped, {reason}")
    for title, make in (("ideal", montecarlo_fields.ideal), ("realistic", montecarlo_fields.Conditions)):
        conditions = make(CAMERA, LIMIT_MAG)
        print(f"{args.fields} {title} fields, seed {args.seed}")
        print(f"{'':18}{'false':>6}{'correct %':>11}{'wrong':>7}{'none':>6}{'median ms':>11}{'worst ms':>10}")
        for k in args.false:
            tallies, bar = {name: montecarlo_fields.Tally() for name in answers}, ProgressBar()
            fields = islice(montecarlo_fields.false_stars(stars, conditions, args.seed, k), args.fields)
            for done, given in enumerate(fields, 1):
                for name, tally in tallies.items():
                    tally.ask(given, given.stars(conditions), answers[name], conditions.tolerance_rad)
                bar(f"{k} false stars", done / args.fields)
            for name, t in tallies.items():
                print(
                    f"{name:18}{k:6d}{100 * t.correct / t.fields:11.2f}{t.wrong:7d}{t.none:6d}"
                    f"{np.median(t.cpu_ms):11.2f}{max(t.cpu_ms):10.1f}",
                    flush=True,
                )
    return 0


if __name__ == "__main__":
    sys.exit(main())

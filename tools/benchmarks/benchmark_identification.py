# SPDX-License-Identifier: Apache-2.0
"""Table of starpos and its peers on the same random fields, in one run.

Peers run
where they can be imported (peers.py): cedar-solve and tetra3rs with databases made here from this program's catalogue
for this field of view (five minutes and one), kept in the cache. So does astrometry.net's engine with FOLDER's index
files (its figures depend on these files: `build-astrometry-index -P 7 .. 10 -n 30` of a V < 9.5 list finds 97 to 98 %).
Every program gets the focal length to 3 %, and the stars in order of brightness; all programs get each field.
"""

import logging
import math
import sys
import time
from collections.abc import Callable, Iterator
from itertools import islice
from pathlib import Path

import numpy as np
import peers
from peers import Absent
from table import Cost, Row, time_text

from starpos import table_cache
from starpos.cli.console import ProgressBar
from starpos.cli.montecarlo import looking
from starpos.fix.solver import Solver
from starpos.instrument.camera import Camera
from starpos.instrument.instrument import Instrument
from starpos.simulation import montecarlo_fields
from starpos.simulation.montecarlo_fields import Tally
from starpos.sky import catalogue

# The paper's camera.
CAMERA = Camera.from_focal(5616, 3744, 93750.0)
FOV_DEG = math.degrees(2 * math.atan(CAMERA.width / 2 / CAMERA.fx))
# A peer's catalogue is deeper by this much, because of the scatter of brightness.
LIMIT_MAG, DEEPER_MAG = 9.0, 0.5
SCALE_ERROR = 0.03
TIMEOUT_MS = 5000


def starpos(stars, args) -> montecarlo_fields.Answer:
    solver = Solver(Instrument(CAMERA.fx), stars, progress=ProgressBar())
    solver.prepare(CAMERA.width, CAMERA.height)
    return looking(solver)


def cedar_solve(stars, args) -> montecarlo_fields.Answer:
    peers.require("cedar-solve")
    # it is written for a numpy of before 2.0
    if not hasattr(np, "math"):
        np.math = math
    from tetra3 import Tetra3

    limit = LIMIT_MAG + DEEPER_MAG
    database = table_cache.cache_folder() / f"cedar-{FOV_DEG:.2f}deg-{limit:g}mag-{stars.fingerprint}.npz"
    solver = Tetra3(load_database=None)
    logging.getLogger("tetra3.Tetra3").setLevel(logging.WARNING)
    if not database.exists():
        print(f"making cedar-solve's database {database} ...", file=sys.stderr)
        begin = time.monotonic()
        source = database.with_name("tyc_main.dat")
        write_tyc_main(stars, limit, source)
        solver.generate_database(
            max_fov=FOV_DEG,
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
            np.stack([given.y, given.x], 1), (given.height, given.width), fov_estimate=FOV_DEG,
            fov_max_error=SCALE_ERROR * FOV_DEG, solve_timeout=TIMEOUT_MS,
        )  # fmt: skip
        return None if found["RA"] is None else unit(found["RA"], found["Dec"])

    return answer


def tetra3rs(stars, args) -> montecarlo_fields.Answer:
    peers.require("tetra3rs")
    import tetra3rs as peer

    limit = LIMIT_MAG + DEEPER_MAG
    kept = table_cache.cache_folder() / f"tetra3rs-{FOV_DEG:.2f}deg-{limit:g}mag-{stars.fingerprint}.db"
    if not kept.exists():
        print(f"making tetra3rs' database {kept} ...", file=sys.stderr)
        source = kept.with_suffix(".stars")
        write_gaia(stars, limit, source)
        peer.SolverDatabase.generate_from_gaia(
            max_fov_deg=FOV_DEG,
            lattice_field_oversampling=100,
            pattern_max_error=0.001,
            epoch_proper_motion_year=2000.0,
            catalog_path=str(source),
            star_max_magnitude=limit,
        ).save_to_file(str(kept))
        source.unlink()
    database = peer.SolverDatabase.load_from_file(str(kept))

    def answer(given):
        x0, y0 = CAMERA.centre_px
        found = database.solve_from_centroids(
            np.stack([given.x - x0, given.y - y0, given.flux], 1), fov_estimate_deg=FOV_DEG,
            image_width=given.width, image_height=given.height, fov_max_error_deg=SCALE_ERROR * FOV_DEG,
            match_radius=0.002, solve_timeout_ms=TIMEOUT_MS,
        )  # fmt: skip
        return unit(found.ra_deg, found.dec_deg) if found else None

    return answer


def write_gaia(stars, limit_mag: float, path: Path) -> None:
    """Make the file of stars that tetra3rs reads: number, J2000 place in deg, magnitude, no proper motion."""
    columns = [
        ("id", "<i8"),
        ("ra", "<f8"),
        ("dec", "<f8"),
        ("mag", "<f4"),
        ("pmra", "<f4"),
        ("pmdec", "<f4"),
    ]
    kept = np.flatnonzero(stars.vmag_centi < 100 * limit_mag)
    table = np.zeros(len(kept), columns)
    table["id"], table["mag"] = np.arange(1, len(kept) + 1), stars.vmag_centi[kept] / 100
    table["ra"], table["dec"] = stars.ra_mas[kept] / 3.6e6, stars.dec_mas[kept] / 3.6e6
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(b"GDR3" + np.uint32(1).tobytes() + np.uint64(len(table)).tobytes() + table.tobytes())


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
    peers.require("astrometry")
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


PROGRAMS = {
    "starpos": starpos,
    "tetra3rs": tetra3rs,
    "cedar-solve": cedar_solve,
    "astrometry.net": astrometry_net,
}


def answers_of(stars, args) -> dict[str, montecarlo_fields.Answer]:
    """The programs that can take part, ready to answer; a line on standard error for each other."""
    # Otherwise the log of one peer would be timed as its work.
    logging.basicConfig(level=logging.WARNING)
    answers = {}
    for name, program in PROGRAMS.items():
        try:
            answers[name] = program(stars, args)
        except Absent as reason:
            print(f"{name}: skipped, {reason}", file=sys.stderr)
    return answers


def tallied(what: str, fields, number: int, conditions, answers) -> dict[str, Tally]:
    """What each program makes of the first `number` fields; each field is given to all, one after the other."""
    tallies, bar = {name: Tally() for name in answers}, ProgressBar()
    for done, given in enumerate(islice(fields, number), 1):
        for name, tally in tallies.items():
            tally.ask(given, given.stars(conditions), answers[name], conditions.tolerance_rad)
        bar(what, done / number)
    return tallies


def cost(tally: Tally) -> Cost:
    """What stands in a cell of the table."""
    text = (
        f"{100 * tally.correct / tally.fields:.1f} %"
        if tally.correct
        else f"{tally.none} of {tally.fields} none"
    )
    text += f", p99 {time_text(float(np.percentile(tally.cpu_ms, 99)))}"
    return Cost(float(np.median(tally.cpu_ms)), text + f", {tally.wrong} wrong" * (tally.wrong > 0))


def rows(options) -> Iterator[Row]:
    """The rows of bench.py: fields as the paper has them and realistic ones next to peers, harder ones alone."""
    stars, number, seed = catalogue.load_catalogue(), options.fields, 1
    answers = answers_of(stars, options)
    alone = {"starpos": answers["starpos"]}
    realistic, ideal = montecarlo_fields.Conditions(camera=CAMERA), montecarlo_fields.ideal(CAMERA)
    kinds: list[tuple[str, Callable, object, dict]] = [
        (f"{k} false", lambda c, k=k: montecarlo_fields.false_stars(stars, c, seed, k), conditions, who)
        for conditions, falses, who in ((ideal, (0, 1, 2), answers), (realistic, (0, 1, 2), answers),
                                        (realistic, (5, 10), alone))
        for k in falses
    ]  # fmt: skip
    kinds += [
        (
            f"the {n} brightest",
            lambda c, n=n: montecarlo_fields.few_stars(stars, c, seed, n),
            realistic,
            alone,
        )
        for n in (5, 6, 7)
    ]
    kinds.append(("random points", lambda c: montecarlo_fields.points(c, seed), realistic, alone))
    together: dict[str, list[Tally]] = {name: [] for name in answers}
    for label, fields, conditions, who in kinds[3:5] if options.quick else kinds:
        what = f"identification, {label}" + ", ideal" * (conditions is ideal)
        tallies = tallied(what, fields(conditions), number, conditions, who)
        yield from compared(what, tallies)
        if conditions is realistic and who is answers:
            for name, tally in tallies.items():
                together[name].append(tally)
    if not options.quick:
        whole = {name: joined(tallies) for name, tallies in together.items()}
        yield from compared("identification, 0 to 2 false together", whole)


def joined(tallies: list[Tally]) -> Tally:
    """All their answers combined into one."""
    whole = Tally()
    for tally in tallies:
        whole.correct, whole.wrong = whole.correct + tally.correct, whole.wrong + tally.wrong
        whole.none, whole.cpu_ms = whole.none + tally.none, whole.cpu_ms + tally.cpu_ms
    return whole


def compared(what: str, tallies: dict[str, Tally]) -> Iterator[Row]:
    """A row for each peer, or one of ours alone."""
    ours = cost(tallies["starpos"])
    theirs = [(name, tally) for name, tally in tallies.items() if name != "starpos"]
    for name, tally in theirs:
        yield Row(what, ours, name, cost(tally))
    if not theirs:
        yield Row(what, ours)


def options(parser) -> None:
    parser.add_argument("--fields", type=int, default=1000, metavar="N", help="of each kind (1000)")
    parser.add_argument("--seed", type=int, default=1, metavar="S", help="of the random numbers (1)")
    parser.add_argument(
        "--false", type=int, nargs="+", default=[0, 1, 2], metavar="K", help="false stars (0 1 2)"
    )
    parser.add_argument("--index", type=Path, metavar="FOLDER", help="astrometry.net's index files")
    parser.add_argument("--peers", type=Path, default=peers.folder(), metavar="FOLDER", help="of peers")


def run(args) -> int:
    peers.look_in(args.peers)
    stars = catalogue.load_catalogue()
    answers = answers_of(stars, args)
    for title, make in (("ideal", montecarlo_fields.ideal), ("realistic", montecarlo_fields.Conditions)):
        conditions = make(camera=CAMERA, limit_mag=LIMIT_MAG)
        print(f"{args.fields} {title} fields, seed {args.seed}")
        print(f"{'':18}{'false':>6}{'correct %':>11}{'wrong':>7}{'none':>6}{'median ms':>11}{'worst ms':>10}")
        for k in args.false:
            fields = montecarlo_fields.false_stars(stars, conditions, args.seed, k)
            for name, t in tallied(f"{k} false stars", fields, args.fields, conditions, answers).items():
                print(
                    f"{name:18}{k:6d}{100 * t.correct / t.fields:11.2f}{t.wrong:7d}{t.none:6d}"
                    f"{np.median(t.cpu_ms):11.2f}{max(t.cpu_ms):10.1f}",
                    flush=True,
                )
    return 0

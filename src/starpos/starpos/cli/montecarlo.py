# SPDX-License-Identifier: Apache-2.0
"""`starpos montecarlo`: the paper's table of identified random fields, made by this program; whole nights as well."""

import argparse
import json
import sys
from collections.abc import Callable, Iterator
from functools import lru_cache, partial
from itertools import islice
from pathlib import Path

import numpy as np

from starpos.cli import console, options, overwriting
from starpos.errors import FrameError
from starpos.fix.solver import Solver
from starpos.frames.frame import Stars
from starpos.instrument.camera import Camera
from starpos.instrument.instrument import Instrument
from starpos.instrument.sensors import SCA100T_CALIBRATED
from starpos.parallel.processes import processors, workers
from starpos.simulation import montecarlo_fields, montecarlo_nights
from starpos.simulation.montecarlo_nights import NightOutcome
from starpos.sky import catalogue, deeper
from starpos.sky.catalogue import Catalogue

RandomNight = Callable[[np.random.Generator, Catalogue], NightOutcome]

# the paper's mean absolute errors of latitude and longitude over its 50 nights
PAPER_ARCSEC = (30.2, 49.0)
PAPER_CLOCK_S = 0.001
ARCSEC_M = 30.87
# share of the nights that must have an answer
SOLVED = 0.95
# for the SCA100T, and for a tiltmeter of 0.1 arcsec
TARGETS_ARCSEC = (1.0, 0.15)
# relative deviation of the normalised error squared from its expectation
ALLOWED = 0.10


def run_nights(args: argparse.Namespace) -> int:
    night = partial(montecarlo_nights.turned_night, errors=_errors(args), clock_stddev_s=PAPER_CLOCK_S)
    solved = [o for o in _all(args, night) if not o.trouble]
    off = np.array([o.off for o in solved]).reshape(-1, 3)
    # North, east m.
    error = np.abs(off[:, 1::-1]).mean(0) if solved else np.full(2, np.nan)
    failed = int(not (len(solved) >= SOLVED * args.nights and np.all(error <= _target_m(args))))
    if args.json:
        console.print_json(
            {
                "nights": args.nights, "solved": len(solved), "mean_abs_north_m": error[0], "mean_abs_east_m": error[1],
                "mean_abs_latitude_arcsec": error[0] / ARCSEC_M, "mean_abs_east_arcsec": error[1] / ARCSEC_M,
                "paper_arcsec": PAPER_ARCSEC,
            }
        )  # fmt: skip
        return failed
    print(
        f"{len(solved)} of {args.nights} nights, mean absolute error (the aim: {_target_m(args) / ARCSEC_M:.3g} arcsec):"
    )
    for name, metres, paper in zip(("latitude", "longitude"), error, PAPER_ARCSEC, strict=True):
        print(
            f"  {name:<10}{metres / ARCSEC_M:7.3f} arcsec on the ground {metres:7.1f} m   (paper {paper} arcsec)"
        )
    heading = np.degrees(np.abs(off[:, 2]).mean()) * 3600 if solved else np.nan
    print(f"  {'heading':<10}{heading:7.3f} arcsec")
    return failed


def run_honesty(args: argparse.Namespace) -> int:
    outcomes = _all(args, partial(_either, errors=_errors(args)))
    rows = [("all", outcomes)] + [(k, [o for o in outcomes if o.kind == k]) for k in ("turned", "calibrated")]
    for label, some in rows:
        solved = [o for o in some if not o.trouble]
        ratios = _nees(solved)
        if args.json:
            keys = ("position_nees", "ground_nees", "heading_nees")
            console.print_json(
                {"row": label, "nights": len(some), "solved": len(solved)}
                | dict(zip(keys, ratios, strict=True))
            )
        else:
            print(
                f"{label:<12}{len(solved):5d} of {len(some)} nights: position {ratios[0]:.3f} (2), on the ground "
                f"{ratios[1]:.3f} (2), heading {ratios[2]:.3f} (1)"
            )
    ratios = _nees([o for o in outcomes if not o.trouble])
    enough = sum(not o.trouble for o in outcomes) >= SOLVED * len(outcomes)
    return int(not (enough and np.all(np.abs(ratios / [2.0, 2.0, 1.0] - 1) < ALLOWED)))


def _target_m(args: argparse.Namespace) -> float:
    """Target in m for the mean absolute errors."""
    sca100t, quiet = TARGETS_ARCSEC
    return ARCSEC_M * (sca100t if args.tiltmeter is None else min(sca100t, quiet * args.tiltmeter / 0.1))


def _nees(solved: list[NightOutcome]) -> np.ndarray:
    """Mean normalised errors squared (3,): of the astronomic place, the geodetic place, and the heading."""
    if not solved:
        return np.full(3, np.nan)
    # a rare night has no heading, because no fix of its last pose was accepted
    return np.nanmean([(o.position_nees, o.ground_nees, o.heading_nees) for o in solved], axis=0)


def _errors(args: argparse.Namespace) -> montecarlo_nights.InclinometerErrors:
    return SCA100T_CALIBRATED if args.tiltmeter is None else montecarlo_nights.tiltmeter(args.tiltmeter)


def _either(
    rng: np.random.Generator, stars: Catalogue, errors: montecarlo_nights.InclinometerErrors
) -> NightOutcome:
    """A night of either kind, with fewer frames than the paper's so that more nights can be solved."""
    if rng.random() < 0.5:
        headings = int(rng.integers(3, 9))
        return montecarlo_nights.turned_night(rng, stars, errors, headings, int(rng.integers(1, 7)))
    return montecarlo_nights.calibrated_night(rng, stars, errors, int(rng.integers(1, 9)))


def _all(args: argparse.Namespace, night: RandomNight) -> list[NightOutcome]:
    """Every night's outcome, independent of the number of processes."""
    seeds, outcomes, bar = np.random.SeedSequence(args.seed).spawn(args.nights), [], console.ProgressBar()
    for k, outcome in enumerate(_each(night, seeds, args.jobs)):
        outcomes.append(outcome)
        if outcome.trouble:
            console.complain(f"night {k}: {outcome.trouble}")
        bar("nights", len(outcomes) / args.nights)
    for o in outcomes if args.json else ():
        sigma = np.sqrt(np.diag(o.covariance))
        console.print_json(
            {
                "kind": o.kind, "east_m": o.off[0], "north_m": o.off[1], "heading_deg": np.degrees(o.off[2]),
                "sigma_east_m": sigma[0], "sigma_north_m": sigma[1], "sigma_heading_deg": np.degrees(sigma[2]),
            }
        )  # fmt: skip
    return outcomes


def _each(
    night: RandomNight, seeds: list[np.random.SeedSequence], jobs: int | None
) -> Iterator[NightOutcome]:
    """The outcome of each seed's night; the first is worked here, so that the triangles are built once."""
    first, *others = seeds
    work = partial(_one, night)
    yield work(first)
    with workers(min(jobs or processors(), len(others))) as processes:
        for outcome in processes.map((work, seed) for seed in others):
            if isinstance(outcome, FrameError):
                raise outcome
            yield outcome


def _one(night: RandomNight, seed: np.random.SeedSequence) -> NightOutcome:
    return night(np.random.default_rng(seed), _stars())


@lru_cache(maxsize=1)
def _stars() -> Catalogue:
    return catalogue.load_catalogue()


# % identified of 1000 fields by number of false stars, and by number of stars
PAPER_FALSE = {0: "99.2", 1: "98.1", 2: "96.7"}
PAPER_FEW = {5: "> 95", 6: "> 99", 7: "> 99.9"}
PAPER_CAMERA = Camera.from_focal(5616, 3744, 93750.0)
# limiting magnitude of the paper's fields, and their mean number of stars
PAPER_LIMIT_MAG, PAPER_STARS = 9.0, 24.9


def run(args: argparse.Namespace) -> int:
    overwriting.check(args, keep=overwriting.failed_fields)
    camera = options.camera_of(args)
    stars = deeper.for_field(catalogue.load_catalogue(), camera)
    conditions = _conditions(args, stars, camera)
    solver = Solver(Instrument(camera.fx), stars, progress=console.ProgressBar())
    solver.prepare(camera.width, camera.height)
    if not args.json:
        _print_head(conditions, stars)
    wrong = 0
    for label, paper, number, fields in _rows(args, stars, conditions):
        tally, bar = montecarlo_fields.Tally(), console.ProgressBar()
        for done, given in enumerate(islice(fields, number), 1):
            tally.ask(given, given.stars(conditions), looking(solver), conditions.tolerance_rad)
            bar(label, done / number)
        wrong += tally.wrong
        _print_row(label, paper, tally, args.json)
        if args.keep:
            _keep(tally, conditions, Path(args.keep))
    return int(wrong > 0)


def looking(solver: Solver) -> montecarlo_fields.Answer:
    """A function that asks `solver` for the direction (3,) in ICRS of a frame's centre."""

    def answer(stars: Stars) -> np.ndarray | None:
        a = solver.identify(stars).pointing
        if a is None:
            return None
        return np.array([np.cos(a.dec) * np.cos(a.ra), np.cos(a.dec) * np.sin(a.ra), np.sin(a.dec)])

    return answer


def _conditions(args: argparse.Namespace, stars: Catalogue, camera: Camera) -> montecarlo_fields.Conditions:
    limit = args.limit_mag
    if limit is None:
        limit = (
            PAPER_LIMIT_MAG
            if camera == PAPER_CAMERA
            else montecarlo_fields.limit_for(camera, stars, PAPER_STARS)
        )
    make = montecarlo_fields.ideal if args.ideal else montecarlo_fields.Conditions
    return make(camera=camera, limit_mag=limit, sigma_px=args.noise_px, focal_error=args.focal_error / 100)


def _rows(
    args: argparse.Namespace, stars: Catalogue, conditions: montecarlo_fields.Conditions
) -> Iterator[tuple[str, str, int, Iterator[montecarlo_fields.Field]]]:
    """Label, the paper's figure in %, number of fields, and fields for each row of the table."""
    papers = conditions.camera == PAPER_CAMERA and conditions.limit_mag == PAPER_LIMIT_MAG
    for k in args.false:
        fields = montecarlo_fields.false_stars(stars, conditions, args.seed, k)
        yield f"{k} false star{'s'[: k != 1]}", PAPER_FALSE.get(k, "") if papers else "", args.fields, fields
    for k in args.stars:
        fields = montecarlo_fields.few_stars(stars, conditions, args.seed, k)
        yield f"{k} stars", PAPER_FEW.get(k, "") if papers else "", args.fields, fields
    number = args.fields // 5 if args.points is None else args.points
    if number:
        yield "random points", "", number, montecarlo_fields.points(conditions, args.seed)


def _print_head(conditions: montecarlo_fields.Conditions, stars: Catalogue) -> None:
    c, camera = conditions, conditions.camera
    width, height = np.degrees(2 * np.arctan([camera.width / 2 / camera.fx, camera.height / 2 / camera.fy]))
    print(
        f"fields of {width:.2f} x {height:.2f} deg, V < {c.limit_mag:g}, centroids to {c.sigma_px:g} px; brightness to "
        f"{c.scatter_mag:g} mag, {100 * c.missing:g} % missing, {c.blend_px:g} px blend, focal length to "
        f"{100 * c.focal_error:g} %; {len(stars)} catalogue stars"
    )
    print(
        f"{'':15}{'fields':>8}{'correct %':>11}   {'(95 %)':16}{'wrong':>6}{'none':>6}   median, worst ms   paper %"
    )


def _print_row(label: str, paper: str, t: montecarlo_fields.Tally, as_json: bool) -> None:
    low, high = montecarlo_fields.wilson(t.correct, t.fields)
    median, worst = (float(f(t.cpu_ms)) if t.cpu_ms else float("nan") for f in (np.median, np.max))
    if as_json:
        console.print_json(
            {
                "row": label, "fields": t.fields, "correct": t.correct, "wrong": t.wrong, "none": t.none,
                "correct_low": low, "correct_high": high, "cpu_ms_median": median, "cpu_ms_worst": worst,
                "paper_percent": paper or None,
            }
        )  # fmt: skip
        return
    share = 100 * t.correct / t.fields if t.fields else float("nan")
    right = f"{share:11.2f}   ({100 * low:.2f} .. {100 * high:.2f})" if label != "random points" else ""
    print(
        f"{label:15}{t.fields:8d}{right:30}{t.wrong:6d}{t.none:6d}{median:9.2f}{worst:8.1f}   {paper:>9}",
        flush=True,
    )


def _keep(tally: montecarlo_fields.Tally, conditions: montecarlo_fields.Conditions, folder: Path) -> None:
    """Write the fields that failed as CSV, with their truth in the first line; raises FrameError."""
    head = {"NAXIS1": conditions.camera.width, "NAXIS2": conditions.camera.height}
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for given, verdict in tally.failed:
            truth = None if given.centre is None else given.centre.tolist()
            lines = ["# " + json.dumps(head | {"VERDICT": verdict, "CENTRE": truth}), "x,y,flux"]
            s = given.stars(conditions)
            lines += [f"{x:.5f},{y:.5f},{flux:.6g}" for x, y, flux in zip(s.x, s.y, s.flux, strict=True)]
            (folder / f"{given.name.replace(' ', '_')}.csv").write_text("\n".join(lines) + "\n", "utf-8")
            print(f"{given.name}: {verdict}, {len(given)} stars", file=sys.stderr)
    except OSError as e:
        raise FrameError(f"{folder}: cannot be written ({e.strerror}): give another --keep") from None

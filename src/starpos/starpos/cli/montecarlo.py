# SPDX-License-Identifier: Apache-2.0
"""`starpos montecarlo`: the paper's table of identified random fields, made by this program."""

import argparse
from collections.abc import Iterator
from itertools import islice

import numpy as np

from starpos.cli import console, options
from starpos.fix.solver import Solver
from starpos.frames.frame import Stars
from starpos.instrument.camera import Camera
from starpos.instrument.instrument import Instrument
from starpos.simulation import montecarlo_fields
from starpos.sky import catalogue, deeper
from starpos.sky.catalogue import Catalogue

# % identified of 1000 fields by number of false stars, and by number of stars
PAPER_FALSE = {0: "99.2", 1: "98.1", 2: "96.7"}
PAPER_FEW = {5: "> 95", 6: "> 99", 7: "> 99.9"}
PAPER_CAMERA = Camera.from_focal(5616, 3744, 93750.0)
# limiting magnitude of the paper's fields, and their mean number of stars
PAPER_LIMIT_MAG, PAPER_STARS = 9.0, 24.9


def run(args: argparse.Namespace) -> int:
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
        _tell_row(args, label, paper, tally)
    return int(wrong > 0)


def looking(solver: Solver) -> montecarlo_fields.Answer:
    """A function that asks `solver` for the direction (3,) in ICRS of a frame's centre."""

    def answer(stars: Stars) -> np.ndarray | None:
        a = solver.identify(stars).pointing
        if a is None:
            return None
        # what is timed is the identification: a vector of two numbers takes less time so
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


def _tell_row(args: argparse.Namespace, label: str, paper: str, t: montecarlo_fields.Tally) -> None:
    low, high = t.interval
    median, worst = (float(f(t.cpu_ms)) if t.cpu_ms else float("nan") for f in (np.median, np.max))
    values = {
        "row": label, "fields": t.fields, "correct": t.correct, "wrong": t.wrong, "none": t.none,
        "correct_low": low, "correct_high": high, "cpu_ms_median": median, "cpu_ms_worst": worst,
        "paper_percent": paper or None,
    }  # fmt: skip
    share = 100 * t.correct / t.fields if t.fields else float("nan")
    right = f"{share:11.2f}   ({100 * low:.2f} .. {100 * high:.2f})" if label != "random points" else ""
    line = f"{label:15}{t.fields:8d}{right:30}{t.wrong:6d}{t.none:6d}{median:9.2f}{worst:8.1f}   {paper:>9}"
    console.tell(args, values, line)

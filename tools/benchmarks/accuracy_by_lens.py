# SPDX-License-Identifier: Apache-2.0
"""What each lens buys: table of docs/how-to/parts.md, as Markdown.

Nights of `bench.py full accuracy` with A3 found by turning (30 headings of 4 frames, an hour), seen through each lens.
Printed are the stars of a frame, and for each level the rms error of one axis of the place against the astronomic truth
and, in brackets, the claimed error.  Then come headings at the end of the nights with each level, whose place is known
from the stars only, against the plumb line's north.  The last heading is of one frame at a known place, as `bench.py
full heading` measures it, against the north of WGS 84.  Lenses are ideal: their distortion is calibrated.
"""

import sys
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace

import numpy as np
from accuracy_by_configuration import (
    CLOCK_S,
    TURNED,
    Night,
    Response,
    cell,
    log_of,
    lost,
    metres,
    outcome,
    photograph,
)
from benchmark_heading import CASES, Case, headings

from starpos.averaging.average import average
from starpos.calibration.misalignment import turn
from starpos.errors import StarposError
from starpos.fix.solver import Solver
from starpos.instrument import sensors
from starpos.instrument.camera import Camera
from starpos.rotation import half_turns
from starpos.simulation.scene import Optics
from starpos.sky.catalogue import load_catalogue
from starpos.units import ARCSEC
from starpos_testing.skies.random_nights import Zero, draw, tiltmeter

PAPERS, WIDE, _ = CASES
# f/1.4, pixels of 1.55 um binned 2 x 2; half of the light of the 25 mm lens's monochrome camera for the same aperture;
# stars scatter by 0.15 px
PI = Case(
    "16 mm, 0.1 s: a Raspberry Pi's HQ camera (IMX477), binned 2 x 2",
    Camera.from_focal(2028, 1520, 16_000 / 3.1),
    Optics(fwhm_px=2.4, zero_point_e_s=2.5e5, read_noise_e=3.0, seeing_arcsec=6.0, limit_mag=7.0),
    0.1,
    60.0,
)
# the 25 mm lens's camera with another lens of f/1.4
LONGER = Case(
    "50 mm, 20 ms: the same camera",
    Camera.from_focal(1936, 1216, 50_000 / 5.86),
    Optics(fwhm_px=2.2, zero_point_e_s=4.8e6, read_noise_e=3.0, seeing_arcsec=2.0, limit_mag=8.0),
    0.02,
    20.0,
)
LENSES = (PI, WIDE, LONGER, PAPERS)
LEVELS = {"SCL3300 as sold": sensors.presets()["scl3300"], "tiltmeter of 0.1 arcsec": tiltmeter(0.1)}


def night_of(task: tuple) -> tuple[Night, list[int], np.ndarray]:
    """A turned night's outcome, the stars of its frames, and error and claim (2,) of its last heading in rad."""
    case, errors, seed = task
    rng, catalogue = np.random.default_rng(seed), load_catalogue()
    world, begin = draw(rng, catalogue, errors, CLOCK_S, case.camera)
    world = replace(world, scene=replace(world.scene, optics=case.optics))
    zero, response = Zero(errors, rng, begin), Response.drawn(errors, rng)
    stars, rows, faces = photograph(world, zero, response, begin, TURNED["an hour"], rng, case.exposure_s)
    solver, tilts = Solver(world.told, catalogue, world.air), log_of(rows, errors)
    counts = [len(s.x) for s in stars]
    try:
        found = turn(solver, stars, tilts)
        last = average(found.fixes)
    except StarposError as e:
        return lost(e), counts, np.full(2, np.nan)
    heading = np.array([half_turns(last.heading - faces[-1]), np.sqrt(last.covariance[2, 2])])
    return outcome(lambda: found.fixes, world), counts, heading


def field(camera: Camera) -> str:
    """Width and height of the picture in deg."""
    width, height = (2 * np.degrees(np.arctan(n / 2 / camera.fx)) for n in (camera.width, camera.height))
    return f"{width:.2g} x {height:.2g} deg"


def options(parser) -> None:
    parser.add_argument("--nights", type=int, default=8, metavar="N", help="of each lens and level (8)")
    parser.add_argument("--frames", type=int, default=100, metavar="N", help="for the heading (100)")
    parser.add_argument("--seed", type=int, default=1, metavar="S", help="(1)")
    parser.add_argument("--jobs", type=int, default=1, metavar="N", help="processes (1)")


def run(args) -> int:
    levels = " | ".join(f"{what}, {name}" for what in ("place", "heading") for name in LEVELS)
    print(f"| lens and exposure | field | a pixel | stars | {levels} | heading at a known place |")
    print("| --- |" + " --- |" * (4 + 2 * len(LEVELS)))
    with ProcessPoolExecutor(args.jobs) as pool:
        for case in LENSES:
            places, faces, counts = [], [], []
            for level, errors in enumerate(LEVELS.values()):
                # the same for all lenses
                seeds = np.random.SeedSequence([args.seed, level]).spawn(args.nights)
                done = list(pool.map(night_of, [(case, errors, seed) for seed in seeds]))
                nights = [night for night, *_ in done]
                lost = [n.trouble for n in nights if n.trouble]
                if lost:
                    print(f"{case.name}: {len(lost)} nights lost: {lost[0]}", file=sys.stderr)
                counts += [count for _, frames, _ in done for count in frames]
                error, claim, _ = cell(nights)
                places.append(f"{metres(error)} ({metres(claim)})")
                off, claim = np.sqrt(np.nanmean([h**2 for *_, h in done], 0)) / ARCSEC
                faces.append(f"{off:.2g} ({claim:.2g}) arcsec")
            seeds = np.random.SeedSequence([args.seed, len(LEVELS)]).spawn(args.frames)
            answers = list(pool.map(headings, [(case, seed) for seed in seeds], chunksize=10))
            found = np.array([a for a in answers if not isinstance(a, str)])[:, :, 0]
            off, claim = np.sqrt((found**2).mean(0))
            print(
                f"| {case.name} | {field(case.camera)} | {case.camera.scale_arcsec:.2g} arcsec | "
                f"{np.median(counts):.0f} | {' | '.join(places + faces)} | {off:.2g} ({claim:.2g}) arcsec |",
                flush=True,
            )
    return 0

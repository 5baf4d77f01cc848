# SPDX-License-Identifier: Apache-2.0
"""How well a frame determines the heading at a known place: table of docs/tutorials/azimuth.md.

Each frame is of a night of its own.  Drawn are the place, its deflection of the vertical (6 arcsec a component, not
stated), and the error of the place (GNSS, 2 m). So are date, pointing (70 deg high), air, clock (1 ms), the Earth's
rotation, the errors of catalogue and stars.  The place is stated on WGS 84.  Printed are the rms error of the heading,
the rms claim, and the mean of the errors squared over the claims (1 where claims are true), from the north of WGS 84 and
from the plumb line's, arcsec.  Exits with status 1 where a limit does not hold.
"""

import sys
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace

import numpy as np

from starpos.earth.ellipsoid import curvature_radii_m, enu_axes
from starpos.earth.place import Place
from starpos.earth.vertical import UNKNOWN_STDDEV_ARCSEC, Deflection, geodetic
from starpos.fix.attitude import heading_of
from starpos.fix.solver import Solver, placed
from starpos.instrument.camera import Camera
from starpos.rotation import half_turns
from starpos.simulation.scene import Optics, detected, expose
from starpos.sky.catalogue import load_catalogue
from starpos.units import ARCSEC
from starpos_testing.skies.random_nights import CAMERA, SCA100T_CALIBRATED, draw

CLOCK_S, PLACE_M, ALTITUDE_DEG = 0.001, 2.0, 70.0
# of errors squared over claims
MIN_RATIO, MAX_RATIO = 0.8, 1.2


@dataclass(frozen=True)
class Case:
    """A camera: its lens and detector, exposure in s, and the limit of the rms error from the north of WGS 84, arcsec."""

    name: str
    camera: Camera
    optics: Optics
    exposure_s: float
    limit_arcsec: float


CASES = (
    Case("600 mm, 0.5 s: the paper's", CAMERA, Optics(), 0.5, 3.0),
    # f/1.4; stars to V = 5.9
    Case(
        "25 mm, 20 ms: a machine vision camera",
        Camera.from_focal(1936, 1216, 25_000 / 5.86),
        Optics(fwhm_px=2.2, zero_point_e_s=1.2e6, read_noise_e=3.0, seeing_arcsec=4.0, limit_mag=7.0),
        0.02,
        20.0,
    ),
    # frames as in cedar-solve's examples: 30.9 arcsec a pixel, 20 to 45 stars that scatter by 0.15 px
    Case(
        "11 x 8.2 deg, 31 arcsec a pixel, 50 ms",
        Camera.from_focal(1280, 960, 6675.0),
        Optics(fwhm_px=2.4, zero_point_e_s=8e5, read_noise_e=3.0, seeing_arcsec=4.6, limit_mag=8.0),
        0.05,
        60.0,
    ),
)


def headings(task: tuple[Case, np.random.SeedSequence]) -> np.ndarray | str:
    """Errors and claims (2, 2) in arcsec of one frame's heading, by WGS 84 and by the plumb line; or why it has none."""
    case, seed = task
    rng, catalogue = np.random.default_rng(seed), load_catalogue()
    world, begin = draw(rng, catalogue, SCA100T_CALIBRATED, CLOCK_S, case.camera)
    scene = replace(world.scene, optics=case.optics, altitude_deg=ALTITUDE_DEG)
    light = expose(scene, world.sky, begin, case.exposure_s, rng)
    mid_s = begin + case.exposure_s / 2 + world.clock_s
    stars = detected(scene, light, mid_s, case.exposure_s, rng)
    # the site of a world is by gravity
    plumb = np.radians([world.site.latitude_deg, world.site.longitude_deg])
    true = Deflection(*rng.normal(0, UNKNOWN_STDDEV_ARCSEC, 2), 0.0)
    ground = geodetic(*plumb.tolist(), 0.0, np.zeros((3, 3)), true)
    prime, meridian = curvature_radii_m(ground.latitude)
    east, north = rng.normal(0, PLACE_M, 2)
    told = Place.on_ellipsoid(
        float(np.degrees(ground.latitude + north / meridian)),
        float(np.degrees(ground.longitude + east / prime / np.cos(ground.latitude))),
        Deflection(),
        np.eye(2) * PLACE_M**2,
    )
    solver = Solver(world.told, catalogue, world.air)
    answer = placed(solver, stars, solver.identify(stars), told)
    if answer.at_place is None:
        return answer.message
    link = scene.attitude @ np.asarray(scene.instrument.link_to_camera)
    on_ground = enu_axes(ground.latitude, ground.longitude) @ enu_axes(*plumb.tolist()).T @ link
    found = answer.at_place.ellipsoid, answer.at_place.plumb
    off = half_turns(
        np.array([a.heading - heading_of(t) for a, t in zip(found, (on_ground, link), strict=True)])
    )
    return np.array([off, [np.sqrt(a.angles_covariance[0, 0]) for a in found]]) / ARCSEC


def options(parser) -> None:
    parser.add_argument("--frames", type=int, default=200, metavar="N", help="of each camera (200)")
    parser.add_argument("--seed", type=int, default=1, metavar="S", help="(1)")
    parser.add_argument("--jobs", type=int, default=1, metavar="N", help="processes (1)")


def row(case: Case, answers: Sequence[np.ndarray | str]) -> tuple[str, bool]:
    """A line of the table, and whether the limits hold."""
    found = np.array([a for a in answers if not isinstance(a, str)])
    off, claim = found[:, 0], found[:, 1]
    rms, claimed = np.sqrt((off**2).mean(0)), np.sqrt((claim**2).mean(0))
    ratio = ((off / claim) ** 2).mean(0)
    cells = [f"{r:.2f} | {c:.2f} | {q:.2f}" for r, c, q in zip(rms, claimed, ratio, strict=True)]
    holds = rms[0] < case.limit_arcsec and MIN_RATIO <= ratio[0] <= MAX_RATIO
    return (
        f"| {case.name} | {len(found)} of {len(answers)} | {' | '.join(cells)} | {case.limit_arcsec:g} |",
        holds,
    )


def run(args) -> int:
    print(
        "| camera | frames | WGS 84: error | claimed | ratio | plumb line: error | claimed | ratio | limit |"
    )
    print("| --- |" + " --- |" * 8)
    all_hold = True
    with ProcessPoolExecutor(args.jobs) as pool:
        for number, case in enumerate(CASES):
            seeds = np.random.SeedSequence([args.seed, number]).spawn(args.frames)
            answers = list(pool.map(headings, [(case, seed) for seed in seeds], chunksize=10))
            line, holds = row(case, answers)
            print(line, flush=True)
            all_hold &= holds
            for why in sorted({a for a in answers if isinstance(a, str)}):
                print(f"{case.name}: {why}", file=sys.stderr)
    return 0 if all_hold else 1

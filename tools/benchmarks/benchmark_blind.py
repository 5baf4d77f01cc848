# SPDX-License-Identifier: Apache-2.0
"""CPU time of blind searches that find nothing: lists of random points, and of points in the gaps of clouds.

`python tools/benchmarks/benchmark_blind.py [FRAMES [SEED]]`. It prints median and worst; none may be identified.
"""

import sys
import time

import numpy as np

from starpos.fix.blind import BlindSolver
from starpos.frames.frame import Stars
from starpos.sky.catalogue import load_catalogue

# widths and heights, px
SIZES = ((640, 480), (1296, 972), (1936, 1096), (4056, 3040))


def points(rng: np.random.Generator, clouds: bool) -> Stars:
    """A list of 15 to 120 points, or of points in four gaps of clouds, with the fluxes of stars."""
    width, height = SIZES[rng.integers(len(SIZES))]
    number = int(rng.integers(15, 120))
    xy = rng.uniform(0, 1, (number, 2)) * [width - 1, height - 1]
    if clouds:
        gaps = rng.uniform(0.1, 0.9, (4, 2)) * [width, height]
        xy = gaps[rng.integers(4, size=number)] + rng.normal(0, height / 12, (number, 2))
        xy = np.clip(xy, 0, [width - 1, height - 1])
    flux = np.sort(100 * rng.uniform(0, 1, number) ** -1.5)[::-1]
    sigma = np.clip(3 / np.sqrt(flux), 0.05, 0.5)
    covariance = np.eye(2) * np.square(sigma)[:, None, None]
    flags = np.zeros(number, np.uint8)
    return Stars(
        x=xy[:, 0],
        y=xy[:, 1],
        flux=flux,
        snr=10 * flux / flux.min(),
        covariance=covariance,
        flags=flags,
        width=width,
        height=height,
    )


def main(frames: int = 30, seed: int = 1) -> int:
    """Print the CPU and wall time of searches that fail; the number that was identified."""
    rng, solver = np.random.default_rng(seed), BlindSolver(load_catalogue())
    solver.prepare()
    wrong = 0
    for clouds in (False, True):
        cpu, wall = [], []
        for _ in range(frames):
            stars = points(rng, clouds)
            begin = time.process_time(), time.perf_counter()
            wrong += solver.identify(stars).pointing is not None
            cpu.append(time.process_time() - begin[0])
            wall.append(time.perf_counter() - begin[1])
        told = (
            f"{name} {np.median(t):.1f} s, worst {max(t):.1f} s" for name, t in (("CPU", cpu), ("wall", wall))
        )
        print(f"{frames} frames of {'clouds' if clouds else 'points'}: {'; '.join(told)}", flush=True)
    print(f"{wrong} identified")
    return wrong


if __name__ == "__main__":
    sys.exit(main(*map(int, sys.argv[1:])) > 0)

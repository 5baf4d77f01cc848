# SPDX-License-Identifier: Apache-2.0
"""CPU time and memory of detection against the frame's size and kind, the number of stars and the share of hot pixels.

Medians of --repeat runs.  sep with windowed positions works on the same
frames, by turns, if it can be imported (peers.py); frames of a colour mosaic are made grey for it by OpenCV, in its time.
Memory is the growth of the process at its peak, over the frame's own bytes (Linux only).
"""

import multiprocessing
import os
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from statistics import median

# CPU time is compared, so each program gets one thread.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import cv2
import numpy as np
import peers
from table import Cost, Row

from starpos.detection import detect
from starpos.frames.frame import Frame

# Mpx: columns, rows.
SIZES = {0.5: (866, 577), 2: (1732, 1155), 8: (3464, 2309), 21: (5616, 3744), 60: (9488, 6324)}
STARS_PER_MPX, STAR_COUNTS, HOT = 15, (10, 100, 1000, 5000), (0.0001, 0.001, 0.003)
# Of 8 bits and of a mosaic: Mpx, stars.
KINDS = ((2, 30), (2, 1000), (21, 315), (21, 5000))
# DN of a step where 8 bits are enough for the frame's noise; sensitivity of a mosaic's colours, rows by columns.
STEP_DN, COLOURS, PATTERN = 14, np.array([[0.6, 1.0], [1.0, 0.7]], np.float32), "rggb"


@dataclass(frozen=True)
class Case:
    """A frame: Mpx, stars, share of hot pixels, bits of a pixel, and whether it is a colour mosaic."""

    mpx: float
    stars: int
    hot: float = 0.0
    bits: int = 16
    mosaic: bool = False

    def __str__(self) -> str:
        kind = ", 8 bit" * (self.bits == 8) + ", mosaic (sep: made grey)" * self.mosaic
        return f"{self.mpx:g} Mpx, {self.stars} stars{kind}" + f", {100 * self.hot:g} % hot pixels" * (
            self.hot > 0
        )


CASES = [
    *(Case(mpx, round(STARS_PER_MPX * mpx)) for mpx in SIZES),
    *(Case(21, n) for n in STAR_COUNTS),
    *(Case(2, n) for n in (*STAR_COUNTS, 300)),
    *(Case(21, 315, hot) for hot in HOT),
    *(Case(mpx, n, bits=8) for mpx, n in KINDS),
    *(Case(mpx, n, bits=bits, mosaic=True) for bits in (16, 8) for mpx, n in KINDS),
]
QUICK = [CASES[1], CASES[3]]
# DN; px; px: half a second of the sky.
SKY, SIGMA, TRAIL = 600, 1.02, np.array([2.6, -2.2])
# A detection this close to a star is of it. A program that has taken so long on a frame gets it no more.
NEAR_PX, ENOUGH_S = 2.0, 5.0


@dataclass(frozen=True)
class Measured:
    """A detection: how many stars, CPU time, peak memory over the frame's bytes, and how far off the bright half is."""

    found: int
    ms: float
    memory: float
    off_px: float

    @property
    def cost(self) -> Cost:
        """What stands in a cell of the table."""
        return Cost(self.ms, f"{self.found} found, {self.off_px:.3f} px off")


def exposure(size, count, rng, hot=0.0, bits=16, mosaic=False):
    """Make a frame of `size` (columns, rows) px with `count` trailed stars, 500 to 100000 DN, most of them faint.

    hot     the share of hot pixels, which have 100 DN more or above, 2000 on average
    bits    16, or 8 with steps of STEP_DN
    mosaic  whether its pixels see COLOURS
    Returns the frame and the places (count, 2) of its stars in px, the brightest first.
    """
    columns, rows = size
    pixels = rng.normal(SKY, 7.0, (rows, columns)).astype(np.float32)
    grid, steps = np.arange(-14, 15), (np.arange(12) + 0.5) / 12 - 0.5
    place = rng.uniform(20, np.array(size) - 20, (count, 2))
    light = np.minimum(500 * (1 + rng.pareto(1, count)), 1e5)
    for (x, y), flux in zip(place, light, strict=True):
        u, v = (grid - (p % 1) - steps[:, None] * t for p, t in zip((x, y), TRAIL, strict=True))
        star = np.exp(-0.5 * (v / SIGMA) ** 2).T @ np.exp(-0.5 * (u / SIGMA) ** 2)
        stamp = np.s_[int(y) - 14 : int(y) + 15, int(x) - 14 : int(x) + 15]
        pixels[stamp] += rng.poisson(star * (flux / star.sum()))
    which = np.flatnonzero(rng.random(pixels.size) < hot)
    pixels.flat[which] += 100 + rng.exponential(2000, len(which))
    if mosaic:
        for row, column in np.ndindex(2, 2):
            pixels[row::2, column::2] *= COLOURS[row, column]
    kind, step = (np.uint8, STEP_DN) if bits == 8 else (np.uint16, 1)
    return np.clip(np.rint(pixels / step), 0, np.iinfo(kind).max).astype(kind), place[np.argsort(-light)]


def with_starpos(pixels, pattern=""):
    """Places (N, 2) px by starpos."""
    stars = detect(Frame(pixels, pattern=pattern)).stars
    return np.stack([stars.x, stars.y], 1)


def of_mosaic(work, pixels):
    """Places (N, 2) px by a program of others, which has the mosaic made grey first."""
    return work(cv2.cvtColor(pixels, cv2.COLOR_BayerBG2GRAY))


def on_mosaics(programs: dict[str, Callable]) -> dict[str, Callable]:
    """The programs, to be called with the pixels of a mosaic. OpenCV calls this pattern by its second row."""
    return {
        name: partial(with_starpos, pattern=PATTERN) if work is with_starpos else partial(of_mosaic, work)
        for name, work in programs.items()
    }


def off_px(found, place) -> float:
    """The median distance of the brighter half of the stars from what was found; NaN if none was."""
    if not len(found):
        return float("nan")
    bright = place[: (len(place) + 1) // 2]
    nearest = np.array([np.hypot(*(found - star).T).min() for star in bright])
    near = nearest[nearest < NEAR_PX]
    return float(np.median(near)) if len(near) else float("nan")


def memory_kb(name):
    return int(Path("/proc/self/status").read_text().split(name + ":")[1].split()[0])


def measured(work: Callable, path: Path) -> Measured:
    """Detect the stars of the frame that is kept at `path`, in a process of its own."""
    # The first call loads modules, which should not count. A small frame leaves little memory for the ones that follow.
    work(exposure((200, 200), 5, np.random.default_rng(1))[0])
    kept = np.load(path)
    pixels, place = kept["pixels"], kept["place"]
    # This resets the peak of memory.
    Path("/proc/self/clear_refs").write_text("5")
    before, begin = memory_kb("VmRSS"), time.process_time()
    found = work(pixels)
    ms = 1e3 * (time.process_time() - begin)
    memory = 1024 * (memory_kb("VmHWM") - before) / pixels.nbytes
    return Measured(len(found), ms, memory, off_px(found, place))


def compared(programs: dict[str, Callable], path: Path, repeat: int) -> dict[str, Measured]:
    """The medians of `repeat` detections by each program, each in its process, by turns."""
    taken: dict[str, list[Measured]] = {name: [] for name in programs}
    with ExitStack() as stack:
        spawn = multiprocessing.get_context("spawn")
        pools = {name: stack.enter_context(spawn.Pool(1)) for name in programs}
        for _ in range(repeat):
            for name, work in programs.items():
                if sum(m.ms for m in taken[name]) < 1e3 * ENOUGH_S:
                    taken[name].append(pools[name].apply(measured, (work, path)))
    return {
        name: Measured(m[0].found, median(k.ms for k in m), max(k.memory for k in m), m[0].off_px)
        for name, m in taken.items()
    }


def cases(programs: dict[str, Callable], which, repeat: int) -> Iterator[tuple[Case, dict[str, Measured]]]:
    """Each case, as in CASES, with what each program makes of it."""
    rng = np.random.default_rng(1)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "frame.npz"
        for case in which:
            pixels, place = exposure(SIZES[case.mpx], case.stars, rng, case.hot, case.bits, case.mosaic)
            np.savez(path, pixels=pixels, place=place)
            yield case, compared(on_mosaics(programs) if case.mosaic else programs, path, repeat)


def rows(options) -> Iterator[Row]:
    """The rows of bench.py: on the frames of QUICK next to all peers, on the others next to sep."""
    here = {name: work for name, work in peers.DETECTORS.items() if peers.is_here(name)}
    sep = {name: work for name, work in here.items() if name == "sep"}
    rest = [] if options.quick else [case for case in CASES if case not in QUICK]
    for beside, which in ((here, QUICK), (sep, rest)):
        for case, found in cases({"starpos": with_starpos} | beside, which, options.rounds):
            what = f"detection, {case}"
            ours = found.pop("starpos").cost
            for name, theirs in found.items():
                yield Row(what, ours, name, theirs.cost)
            if not found:
                yield Row(what, ours)


def options(parser) -> None:
    parser.add_argument("--repeat", type=int, default=3)
    parser.add_argument("--peers", type=Path, default=peers.folder(), metavar="FOLDER", help="of peers")


def run(options) -> int:
    peers.look_in(options.peers)
    programs = {"starpos": with_starpos}
    if peers.is_here("sep"):
        programs["sep"] = peers.with_sep
    print(f"{'frame':60}" + "".join(f" | {name:>8} found {'ms':>7} ms/Mpx memory" for name in programs))
    for case, found in cases(programs, CASES, options.repeat):
        line = f"{case!s:60}"
        for m in found.values():
            line += f" | {m.found:14d} {m.ms:7.1f} {m.ms / case.mpx:6.1f} {m.memory:6.2f}"
        print(line, flush=True)

# SPDX-License-Identifier: Apache-2.0
"""CPU time and memory of detection against the frame's size, the number of stars and the share of hot pixels.

`benchmark_detection.py [--repeat N]`.  sep with windowed positions works on the same frames if it can be imported
(`pip install sep`).  Memory is the growth of the process at its peak, over the frame's own bytes (Linux only).
"""

import argparse
import importlib.util
import multiprocessing
import os
import tempfile
import time
from pathlib import Path

# CPU time is compared, so each program gets one thread.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np

from starpos.detection import detect
from starpos.frames.frame import Frame

# Mpx: columns, rows.
SIZES = {
    0.5: (866, 577),
    2: (1732, 1155),
    8: (3464, 2309),
    21: (5616, 3744),
    60: (9488, 6324),
}
STARS_PER_MPX, STAR_COUNTS, HOT = 15, (10, 100, 1000, 5000), (0.0001, 0.001, 0.003)
# DN; px; px: half a second of the sky.
SKY, SIGMA, TRAIL = 600, 1.02, np.array([2.6, -2.2])


def exposure(size, count, rng, hot=0.0):
    """Make a 16-bit frame of `size` (columns, rows) px with `count` trailed stars, 500 to 100000 DN, most of them faint.

    hot: the share of hot pixels, which have 100 DN more or above, 2000 on average.
    """
    columns, rows = size
    pixels = rng.normal(SKY, 7.0, (rows, columns)).astype(np.float32)
    grid, steps = np.arange(-14, 15), (np.arange(12) + 0.5) / 12 - 0.5
    place = rng.uniform(20, np.array(size) - 20, (count, 2))
    for (x, y), flux in zip(place, np.minimum(500 * (1 + rng.pareto(1, count)), 1e5), strict=True):
        u, v = (grid - (p % 1) - steps[:, None] * t for p, t in zip((x, y), TRAIL, strict=True))
        star = np.exp(-0.5 * (v / SIGMA) ** 2).T @ np.exp(-0.5 * (u / SIGMA) ** 2)
        stamp = np.s_[int(y) - 14 : int(y) + 15, int(x) - 14 : int(x) + 15]
        pixels[stamp] += rng.poisson(star * (flux / star.sum()))
    which = np.flatnonzero(rng.random(pixels.size) < hot)
    pixels.flat[which] += 100 + rng.exponential(2000, len(which))
    return np.clip(np.rint(pixels), 0, 65535).astype(np.uint16)


def with_starpos(pixels):
    return len(detect(Frame(pixels)).stars)


def with_sep(pixels):
    import sep

    plane = pixels.astype(np.float32)
    background = sep.Background(plane)
    plane -= background
    found = sep.extract(plane, 5, err=background.globalrms)
    sep.winpos(plane, found["x"], found["y"], np.full(len(found), 2.0))
    return len(found)


def memory_kb(name):
    return int(Path("/proc/self/status").read_text().split(name + ":")[1].split()[0])


def measured(work, path, repeat):
    """Detect; return the number of stars, CPU ms (the quickest of `repeat`), and peak memory over the frame's bytes."""
    # The first call loads modules, which should not count. A small frame leaves little memory for the ones that follow.
    work(exposure((200, 200), 5, np.random.default_rng(1)))
    pixels = np.load(path)
    # This resets the peak of memory.
    Path("/proc/self/clear_refs").write_text("5")
    before, times = memory_kb("VmRSS"), []
    for _ in range(repeat):
        begin = time.process_time()
        count = work(pixels)
        times.append(time.process_time() - begin)
    return count, 1e3 * min(times), 1024 * (memory_kb("VmHWM") - before) / pixels.nbytes


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--repeat", type=int, default=3)
    repeat = parser.parse_args().repeat
    programs = {"starpos": with_starpos}
    if importlib.util.find_spec("sep"):
        programs["sep"] = with_sep
    print(
        f"{'Mpx':>6} {'stars':>6} {'hot':>6}"
        + "".join(f" | {name:>8} found {'ms':>7} ms/Mpx memory" for name in programs)
    )
    rng = np.random.default_rng(1)
    cases = [(mpx, round(STARS_PER_MPX * mpx), 0.0) for mpx in SIZES] + [(21, n, 0.0) for n in STAR_COUNTS]
    cases += [(21, 315, hot) for hot in HOT]
    with (
        tempfile.TemporaryDirectory() as folder,
        multiprocessing.get_context("spawn").Pool(1, maxtasksperchild=1) as pool,
    ):
        path = Path(folder) / "frame.npy"
        for mpx, count, hot in cases:
            np.save(path, exposure(SIZES[mpx], count, rng, hot))
            line = f"{mpx:6g} {count:6d} {hot:6g}"
            for work in programs.values():
                found, ms, memory = pool.apply(measured, (work, path, repeat))
                line += f" | {found:14d} {ms:7.1f} {ms / mpx:6.1f} {memory:6.2f}"
            print(line, flush=True)


if __name__ == "__main__":
    main()

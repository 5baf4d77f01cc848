# SPDX-License-Identifier: Apache-2.0
"""Instructions that the steps of a frame take, which a busy machine does not change, and what they come to on a board.

Needs valgrind.  Numerical libraries are held to vectors of 128 bits, as an ARM core has them.  The time on a board is
instructions / (instructions a cycle x clock), with the figures of BOARDS: an estimate, nothing here runs on a board.
"""

import ctypes
import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

import numpy as np
from benchmark_detection import SIZES, exposure, with_starpos
from benchmark_steps import Shot, night
from table import by_turns, circumstances, digits, show, spent_ms, time_text

# Callgrind counts while this function of libffi runs, by which ctypes makes a call, and writes a file at its end.
GATE = "ffi_call"
# A name: columns, rows; stars. The second is the first with four pixels made one.
FRAMES = {"21 Mpx": (SIZES[21], 315), "5 Mpx (21 binned 2 x 2)": ((2808, 1872), 315), "2 Mpx": (SIZES[2], 30)}
# A node's work on a frame besides detection, or without it, in million instructions a megapixel. It is not counted, but
# derived from the CPU time of the nodes on a server (AMD EPYC, 26 November 2026), less detection's, at 7.4 instructions a
# ns as detection had there.
NODES = {
    "node `camera_detector`": (True, 30),
    "node `detector` beside `camera`": (True, 35),
    "node `camera` beside `detector`": (False, 57),
}
# No wider vectors than NEON's 128 bits, one thread, and the same order of things in every run.
AS_ON_A_BOARD = {
    "NPY_DISABLE_CPU_FEATURES": "X86_V3 X86_V4 AVX2 FMA3 AVX512F AVX512_SKX",
    "OPENCV_CPU_DISABLE": "AVX,AVX2,FMA3,FP16,AVX512-SKX",
    "OPENBLAS_CORETYPE": "Nehalem",
    "OPENBLAS_NUM_THREADS": "1",
    "OMP_NUM_THREADS": "1",
    "PYTHONHASHSEED": "0",
}


@dataclass(frozen=True)
class Board:
    """A board: its core's instructions a cycle (least, likely, most) and its clock in GHz."""

    name: str
    per_cycle: tuple[float, float, float]
    ghz: float

    def ms(self, instructions: float) -> tuple[float, float, float]:
        """Estimated CPU time: least, likely, most."""
        least, likely, most = self.per_cycle
        return tuple(1e-6 * instructions / (rate * self.ghz) for rate in (most, likely, least))


# Where the figures come from, and how far off they may be: docs/how-to/small_boards.md.
BOARDS = (
    Board("Pi 4 (Cortex-A72, 1.5 GHz)", (0.7, 1.0, 1.5), 1.5),
    Board("Pi 5 (Cortex-A76, 2.4 GHz)", (1.1, 1.5, 2.2), 2.4),
)


def detection_of(name: str) -> str:
    """The row of a frame's detection."""
    return f"detection, {name}, {FRAMES[name][1]} stars"


def works(folder: Path) -> Iterator[tuple[str, Callable[[], object]]]:
    """Each step by its name, ready to be done again and again."""
    for name in FRAMES:
        pixels = np.load(folder / f"{name}.npy")
        yield detection_of(name), lambda pixels=pixels: with_starpos(pixels)
    shot = Shot()
    number = len(shot.identify().names)
    yield f"identification, warm, {number} stars", shot.identify
    yield f"one fix (`solve_fix`), {number} stars", shot.fix()
    hint = shot.solver.solve(shot.stars, shot.tilt).hint
    yield "a star list to its fix, the next", lambda: shot.solver.solve(shot.stars, shot.tilt, hint)


def gated(work: Callable[[], object]) -> None:
    """Do a work within a call of GATE: the C library's `lfind` compares by calling it."""
    compare = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_void_p, ctypes.c_void_p)

    def once(_a, _b):
        work()
        return 0

    room, one = ctypes.create_string_buffer(8), ctypes.c_size_t(1)
    ctypes.CDLL(None).lfind(room, room, ctypes.byref(one), ctypes.c_size_t(8), compare(once))


def total(path: Path) -> int:
    """The instructions that a file of callgrind counts."""
    with path.open() as lines:
        return sum(int(line.split()[1]) for line in lines if line.startswith("totals:"))


def counted(folder: Path) -> None:
    """Do each work twice, within valgrind, count the second, and print a line of JSON for each."""
    for name, work in works(folder):
        work()
        before = set(folder.glob("count.*"))
        gated(work)
        instructions = sum(map(total, set(folder.glob("count.*")) - before))
        if not instructions:
            raise SystemExit(f"callgrind counted nothing: it sees no function {GATE} in this Python")
        print(json.dumps([name, instructions]), flush=True)


def timed(folder: Path) -> None:
    """Without valgrind: print a line of JSON for each work, its CPU time in ms."""
    for line in by_turns(dict(works(folder))).items():
        print(json.dumps(line), flush=True)


def said(command: list[str]) -> Iterator[tuple[str, float]]:
    """What a run of this file prints, line by line."""
    environment = os.environ | AS_ON_A_BOARD
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment) as run:
        for line in run.stdout:
            yield tuple(json.loads(line))
    if run.returncode:
        raise SystemExit(run.returncode)


def valgrind(out: Path, *more: str) -> list[str]:
    """The beginning of a command that counts; the workspace's Python starts itself anew, so children are followed."""
    return [
        "valgrind",
        "-q",
        "--tool=callgrind",
        "--trace-children=yes",
        f"--callgrind-out-file={out}",
        *more,
    ]


def start(folder: Path) -> tuple[int, float]:
    """Instructions and CPU time (ms) of `starpos solve` of a star list, from nothing, its tables in the cache."""
    command = [sys.executable, "-m", "starpos", *night(folder)]
    environment = os.environ | AS_ON_A_BOARD

    def run(before: list[str]) -> None:
        subprocess.run([*before, *command], env=environment, stdout=subprocess.DEVNULL, check=True)

    run([])
    ms = spent_ms(lambda: run([]))
    run(valgrind(folder / "start.%p"))
    return sum(map(total, folder.glob("start.*"))), ms


def table(rows: Iterator[tuple[str, float, float | None]]) -> Iterator[str]:
    """The table in Markdown of (what, instructions, CPU ms here if it was measured)."""
    names = " | ".join(board.name for board in BOARDS)
    yield f"| what | million instructions | here | {names} |\n| --- | ---: | ---: |{' ---: |' * len(BOARDS)}"
    for what, instructions, ms in rows:
        cells = [digits(instructions / 1e6, 3), "" if ms is None else time_text(ms)]
        for board in BOARDS:
            least, likely, most = map(time_text, board.ms(instructions))
            cells.append(f"{likely} ({least} to {most})")
        yield f"| {what} | {' | '.join(cells)} |"


def of_nodes(detection: dict[str, float]) -> Iterator[tuple[str, float, None]]:
    """What a frame costs each node, from the instructions of its detection, by the name of the frame."""
    for node, (detects, million_a_mpx) in NODES.items():
        for name, ((columns, rows), _) in FRAMES.items():
            yield f"{node}, {name}", detects * detection[name] + million_a_mpx * columns * rows, None


def measured(folder: Path) -> Iterator[tuple[str, float, float | None]]:
    """Each step with its instructions and its CPU time (ms) here."""
    rng = np.random.default_rng(1)
    for name, (size, stars) in FRAMES.items():
        np.save(folder / f"{name}.npy", exposure(size, stars, rng)[0])
    again = [sys.executable, str(Path(__file__)), str(folder)]
    ms = dict(said([*again, "--timed"]))
    gate = (f"--toggle-collect={GATE}", f"--dump-after={GATE}")
    counts = {}
    for what, counts[what] in said([*valgrind(folder / "count.%p", *gate), *again]):
        yield what, counts[what], ms[what]
    yield from of_nodes({name: counts[detection_of(name)] for name in FRAMES})
    print("the start ...", file=sys.stderr, flush=True)
    yield "start to the first answer, `starpos solve` of a star list", *start(folder)


def options(parser) -> None:
    parser.add_argument("--into", type=Path, metavar="DOCUMENT", help="whose table is replaced")


def run(options) -> int:
    if shutil.which("valgrind") is None:
        print("valgrind is not here, and it is what counts: apt install valgrind", file=sys.stderr)
        return 1
    print("about three minutes: valgrind is 50 times slower than the processor", file=sys.stderr, flush=True)
    with tempfile.TemporaryDirectory() as folder:
        show(chain(table(measured(Path(folder))), ["", circumstances()]), options.into)
    return 0


if __name__ == "__main__":
    # the works themselves, within valgrind, for `run`
    (timed if "--timed" in sys.argv else counted)(Path(sys.argv[1]))

# SPDX-License-Identifier: Apache-2.0
"""Comparison of `starpos solve --jobs N` with --jobs 1, on simulated frames of the paper's size and on star lists.

Whole commands are timed, with start and end of
the processes, 1 and N by turns; the best round counts, because other work on the machine only slows.  The CPU time of
all processes shows the possible speed on a machine that always has other work.  The answers are compared byte by byte.
"""

import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from itertools import islice
from pathlib import Path

import numpy as np
from table import Cost, Row

from starpos.cli import main as starpos
from starpos.parallel.processes import Processes, processors

OPTICS = ("--focal-mm", "600", "--pixel-um", "6.4")
# Frames simulated; a longer night repeats them.
AT_ONCE = 8
# The tests' bag, and how many star lists it holds.
NIGHT, LISTS = Path(__file__).resolve().parents[2] / "test" / "data" / "night", 10


def timed(command: list[str]) -> tuple[np.ndarray, bytes]:
    """Run a command; return wall and CPU time in s, and its output."""
    begin, before = time.perf_counter(), resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run([sys.executable, "-m", "starpos", *command], stdout=subprocess.PIPE, check=True)
    wall, after = time.perf_counter() - begin, resource.getrusage(resource.RUSAGE_CHILDREN)
    return np.array([wall, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime]), done.stdout


def best_of(folder: Path, number: int, jobs: int, rounds: int) -> tuple[dict[int, np.ndarray], bool]:
    """The least wall and CPU time (s) of a night on 1 and on several processes, and whether the answers are the same."""
    some = sorted(str(p) for p in folder.iterdir() if p.stem.startswith(("frame", "stars")))
    given = [some[k % len(some)] for k in range(number)]
    command = ["solve", *given, "--tilt", str(folder / "tilt.csv"), *OPTICS, "--json", "--jobs"]
    # This brings files and triangles into memory.
    timed([*command, "1"])
    best = {1: np.full(2, np.inf), jobs: np.full(2, np.inf)}
    answers = set()
    for _ in range(rounds):
        for n in best:
            spent, out = timed([*command, str(n)])
            best[n] = np.minimum(best[n], spent)
            answers.add(out)
    return best, len(answers) == 1


def compare(what: str, folder: Path, number: int, jobs: int, rounds: int) -> None:
    """Print a line of the table."""
    best, same = best_of(folder, number, jobs, rounds)
    (wall, cpu), (wall_of_many, cpu_of_many) = best[1], best[jobs]
    print(
        f"{what:<12}{number:6d}{wall:11.2f}{wall_of_many:9.2f}{wall_of_many / wall:8.2f}{cpu:10.2f}{cpu_of_many:9.2f}"
        f"   {'yes' if same else 'NO'}",
        flush=True,
    )


def nothing(of):
    """Do nothing, so that only sending costs time."""
    return of


def overhead_ms(jobs: int, calls: int = 2000) -> tuple[float, float]:
    """Time for starting the processes, and for a call, in ms."""
    begin = time.perf_counter()
    with Processes(jobs) as workers:
        answers = workers.map((nothing, str(k)) for k in range(calls + 100))
        list(islice(answers, 100))
        ready = time.perf_counter()
        list(answers)
        end = time.perf_counter()
    return 1000 * (ready - begin), 1000 * (end - ready) / calls


def simulated(folder: Path, number: int, *more: str) -> Path:
    """Make a night of a number of frames, AT_ONCE at most."""
    starpos(["simulate", str(folder), "-n", str(min(number, AT_ONCE)), *OPTICS, *more])
    return folder


def rows(options) -> Iterator[Row]:
    """The rows of bench.py."""
    number, jobs = 100, 2
    with tempfile.TemporaryDirectory() as scratch:
        best, same = best_of(simulated(Path(scratch) / "lists", number, "--stars-only"), number, jobs, 1)
    note = "the same answers" if same else "OTHER ANSWERS"
    ours, alone = Cost(1000 * best[jobs][1], note), Cost(1000 * best[1][1])
    yield Row(f"{number} star lists solved on {jobs} processes, all their CPU", ours, "on one process", alone)
    (_, cpu_s), _ = timed(["replay", *[str(NIGHT)] * (number // LISTS)])
    yield Row(f"{number} star lists replayed from bags, all their CPU", Cost(1000 * cpu_s), "solved", alone)


def options(parser) -> None:
    parser.add_argument("--frames", type=int, default=40)
    parser.add_argument("--lists", type=int, default=400)
    parser.add_argument("--jobs", type=int, default=processors())
    parser.add_argument("--rounds", type=int, default=3)


def run(args) -> int:
    start, call = overhead_ms(args.jobs)
    print(f"{args.jobs} processes start within {start:.0f} ms; a call costs {call:.2f} ms besides its work")
    n = args.jobs
    print(f"{'':12}number  wall 1, s  {n:4d}, s   ratio  CPU 1, s  {n:4d}, s   same answers", flush=True)
    with tempfile.TemporaryDirectory() as scratch:
        for what, number, more in (
            ("frames", args.frames, ()),
            ("star lists", args.lists, ("--stars-only",)),
        ):
            folder = simulated(Path(scratch) / what.replace(" ", ""), number, *more)
            compare(what, folder, number, args.jobs, args.rounds)

# SPDX-License-Identifier: Apache-2.0
"""Start all nodes and end them, time and again, several instruments at once: does each process end, how, and how soon?

Camera, detector, inclinometer and solver of each instrument work until they have said so; then each gets a SIGINT, twice,
as launch sends it. `--load N` adds N processes that only compute. A process that ends with another status than 0, or
does not end within the middleware's bound and a margin, is a failure; one that the bound has ended is counted.
Exit status 1 if a process failed.
"""

import signal
import subprocess
import sys
import time
from contextlib import ExitStack

from diagnostic_msgs.msg import DiagnosticArray
from runner import Progress

from starpos_common.node_main import MAX_END_S
from starpos_testing.nodes import Listener, Process, take_domain

# a busy machine schedules a process late
MARGIN_S = 10.0
NODES = {
    "camera": ("starpos_camera.main", ("source:=simulated", "focal_mm:=14.8", "simulated.width:=640",
                                       "simulated.height:=427", "cadence:=0.5")),
    "detector": ("starpos_camera.main", ()),
    "inclinometer": ("starpos_inclinometer.main", ("source:=ascii", "port:=/dev/null")),
    "solver": ("starpos_solver.main", ()),
}  # fmt: skip


def options(parser) -> None:
    parser.add_argument("--times", type=int, default=100, help="starts of each instrument")
    parser.add_argument("--instruments", type=int, default=3, help="at once")
    parser.add_argument("--load", type=int, default=2, help="processes that only compute")


def run(options) -> int:
    take_domain()
    failed, bounded, slowest_s, ends = 0, 0, 0.0, 0
    progress = Progress(options.times, "starts")
    with ExitStack() as held:
        for _ in range(options.load):
            burner = subprocess.Popen([sys.executable, "-c", "while True: pass"])
            held.callback(burner.kill)
        for k in range(1, options.times + 1):
            for name, status, took_s, said in one_round(options.instruments):
                ends += 1
                slowest_s = max(slowest_s, took_s)
                bounded += took_s >= MAX_END_S
                if status != 0 or took_s > MAX_END_S + MARGIN_S:
                    failed += 1
                    print(f"{name} ended with {status} after {took_s:.1f} s: {said[-300:]}")
            progress.at(k, f"{ends} ends, {failed} failed, {bounded} by the bound")
    print(
        f"{ends} processes ended, {failed} of them wrongly, {bounded} took the bound of {MAX_END_S:g} s; the slowest "
        f"took {slowest_s:.1f} s"
    )
    return int(failed > 0)


def one_round(instruments: int) -> list[tuple[str, int, float, str]]:
    """Start and end instruments once: of each process the name, exit status, seconds and output."""
    listener = Listener()
    heard: list[DiagnosticArray] = listener.hear(DiagnosticArray, "/diagnostics", 100)
    processes = [
        (name, Process(module, name, parameters, f"/i{k}"))
        for k in range(instruments)
        for name, (module, parameters) in NODES.items()
    ]
    try:
        # each node publishes once a second
        listener.wait(lambda: len(heard) >= instruments * len(NODES))
        done = []
        for name, process in processes:
            begin = time.monotonic()
            status, said = process.end(signal.SIGINT, signal.SIGINT)
            done.append((name, status, time.monotonic() - begin, said))
        return done
    finally:
        listener.close()

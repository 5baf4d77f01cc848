# SPDX-License-Identifier: Apache-2.0
"""A day of the installed solver, as fast as it answers: CPU time a frame, and whether its memory grows.

Exit status 1 if the memory of the last half has grown by more than 2 MB against the half before.
"""

import tempfile
from pathlib import Path

from runner import Memory, Progress

from starpos_testing.domain import own_domain
from starpos_testing.processes import cpu_s

WARM, ALLOWED_MB = 500, 2.0


def options(parser) -> None:
    parser.add_argument("--frames", type=int, default=17280, help="17280: a day of one every 5 s")


def run(options) -> int:
    from starpos_testing.graph.graph import Graph
    from starpos_testing.graph.shots import SOLVER, shoot

    frames, progress = options.frames, Progress(options.frames, "frames")
    with own_domain(), tempfile.TemporaryDirectory() as folder:
        graph = Graph()
        try:
            solver = graph.start(Path(folder) / "log", "starpos_solver", "solver", *SOLVER)
            graph.wait_for_solver()
            graph.answer(shoot())
            for k in range(frames):
                answer = graph.answer(shoot())[0]
                assert answer.status == answer.OK, answer.status_text
                for kept in (graph.solutions, graph.fixes, graph.imus, graph.diagnostics):
                    kept.clear()
                if k <= WARM:
                    memory, begin_s = Memory(solver.process.pid), cpu_s(solver.process.pid)
                memory.look()
                progress.at(k + 1, memory)
            each_ms = 1e3 * (cpu_s(solver.process.pid) - begin_s) / max(1, frames - WARM - 1)
        finally:
            graph.close()
    print(f"{frames} frames: {each_ms:.1f} ms of CPU each; the last half's memory {memory.grown:+.2f} MB")
    return int(memory.grown > ALLOWED_MB)

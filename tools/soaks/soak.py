# SPDX-License-Identifier: Apache-2.0
"""A day of the installed solver, as fast as it answers: memory and CPU time per frame, and whether they grow.

    python tools/soaks/soak.py [FRAMES]          17280: a day of one frame every 5 s

Exit status 0; 1 if the memory of the last half has grown by more than 2 MB against the half before.
"""

import sys
import tempfile
from pathlib import Path

from starpos_testing.domain import own_domain
from starpos_testing.processes import cpu_s, memory_mb

DAY, WARM, ALLOWED_MB = 17280, 500, 2.0


def main() -> int:
    from starpos_testing.graph.graph import Graph
    from starpos_testing.graph.shots import SOLVER, shoot

    frames = int(sys.argv[1]) if len(sys.argv) > 1 else DAY
    with own_domain(), tempfile.TemporaryDirectory() as folder:
        graph = Graph()
        try:
            solver = graph.start(Path(folder) / "log", "starpos_solver", "solver", *SOLVER)
            graph.wait_for_solver()
            graph.answer(shoot())
            sizes, begin_s = [], 0.0
            for k in range(frames):
                shot = shoot()
                answer = graph.answer(shot)[0]
                assert answer.status == answer.OK, answer.status_text
                for kept in (graph.solutions, graph.fixes, graph.imus, graph.diagnostics):
                    kept.clear()
                if k == WARM:
                    begin_s = cpu_s(solver.process.pid)
                if k >= WARM:
                    sizes.append(memory_mb(solver.process.pid))
                if k % max(1, frames // 20) == 0:
                    print(f"{k:6d} frames  {memory_mb(solver.process.pid):7.1f} MB", flush=True)
            each_ms = 1e3 * (cpu_s(solver.process.pid) - begin_s) / max(1, frames - WARM - 1)
        finally:
            graph.close()
    half = len(sizes) // 2
    grown = max(sizes[half:]) - max(sizes[:half])
    print(
        f"{frames} frames: {each_ms:.1f} ms of CPU each; the last half's memory {grown:+.2f} MB against the first's"
    )
    return int(grown > ALLOWED_MB)


if __name__ == "__main__":
    sys.exit(main())

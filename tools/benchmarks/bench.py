# SPDX-License-Identifier: Apache-2.0
"""One table of the cost of everything: CPU time here and of other programs that do the same, and the ratio, in one run.

`make bench`, or `. tools/env.sh && python tools/benchmarks/bench.py [GROUP ...] [--quick] [--peers FOLDER]`.  Works are
done by turns, so that what else the machine does falls on all of them: trust the ratio, not the time.
`bench.py full KIND [OPTIONS]` is a longer measurement: more cases, memory, accuracy, targets (`bench.py full --help`).
"""

import argparse
import importlib
import os
import sys
from collections.abc import Iterator
from itertools import chain
from pathlib import Path

# CPU time is compared, so each program gets one thread.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("RAYON_NUM_THREADS", "1")

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import peers
import runner
from table import HEAD, Row, circumstances, show

# By its name: the benchmark whose `rows` it is.
GROUPS = {
    "detection": "benchmark_detection",
    "identification": "benchmark_identification",
    "steps": "benchmark_steps",
    "inclinometer": "driver_throughput",
    "compression": "benchmark_compression",
    "jobs": "benchmark_jobs",
    "navigation": "benchmark_navigation",
    "navigator": "benchmark_navigator",
    "nodes": "latency",
}
# What `full` measures: the benchmark whose `run` it is.
FULL = {
    "accuracy": "accuracy_by_configuration",
    "deflection": "benchmark_deflection",
    "detection": "benchmark_detection",
    "heading": "benchmark_heading",
    "identification": "benchmark_identification",
    "instructions": "instructions",
    "jobs": "benchmark_jobs",
    "lenses": "accuracy_by_lens",
    "link": "link_bandwidth",
    "navigation": "benchmark_navigation",
    "nodes": "latency",
    "rates": "camera_rates",
}


def rows(groups: list[str], options: argparse.Namespace) -> Iterator[Row]:
    """The rows of each group; one that cannot run here is a line on standard error."""
    for number, group in enumerate(groups, 1):
        print(f"{group} ({number} of {len(groups)}) ...", file=sys.stderr, flush=True)
        try:
            benchmark = importlib.import_module(GROUPS[group])
        except ImportError as reason:
            print(f"{group}: skipped, {reason} (make build, . tools/env.sh)", file=sys.stderr)
            continue
        yield from benchmark.rows(options)


def main() -> int:
    if sys.argv[1:2] == ["full"]:
        kinds = {name: Path(__file__).with_name(f"{module}.py") for name, module in FULL.items()}
        return runner.main("A longer measurement of one part.", kinds, sys.argv[2:], "full")
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("groups", nargs="*", metavar="GROUP", help=f"of {', '.join(GROUPS)} (all)")
    parser.add_argument("--quick", action="store_true", help="the main figures alone, in a minute")
    parser.add_argument("--rounds", type=int, default=5, metavar="N", help="of which the median counts (5)")
    parser.add_argument(
        "--fields", type=int, default=200, metavar="N", help="to identify, of each kind (200)"
    )
    parser.add_argument("--peers", type=Path, default=peers.folder(), metavar="FOLDER", help="of peers")
    parser.add_argument("--into", type=Path, metavar="DOCUMENT", help="whose table is replaced")
    parser.add_argument("--index", type=Path, metavar="FOLDER", help="astrometry.net's index files")
    options = parser.parse_args()
    if unknown := set(options.groups) - set(GROUPS):
        parser.error(f"no group {', '.join(sorted(unknown))}; there are {', '.join(GROUPS)}")
    peers.look_in(options.peers)
    if missing := peers.how_to_get(options.peers):
        print(missing, file=sys.stderr)
    made = map(str, rows(options.groups or list(GROUPS), options))
    show(chain([HEAD], made, ["", circumstances()]), options.into)
    return 0


if __name__ == "__main__":
    sys.exit(main())

# SPDX-License-Identifier: Apache-2.0
"""Where the frames of a call are worked: --jobs and --scheduler."""

import argparse
import sys
from collections.abc import Iterable, Iterator
from contextlib import suppress

from starpos.cli import common
from starpos.cli.frame_work import About
from starpos.errors import InstrumentError, StarposError
from starpos.fix.solver import Solver
from starpos.instrument.instrument import Instrument
from starpos.parallel.call import Here, Workers
from starpos.parallel.cluster import Cluster
from starpos.parallel.processes import Processes, processors
from starpos.sky import catalogue

MOST_JOBS = 1000
AUTO = "auto"


def add_jobs(parser: argparse.ArgumentParser) -> None:
    """What `workers_of` reads."""
    parser.add_argument(
        "--jobs",
        type=_jobs,
        metavar="N|auto",
        help="work frames on so many processes of this machine (1; auto or 0: one a processor)",
    )
    parser.add_argument(
        "--scheduler",
        metavar="ADDRESS",
        help="work them on a dask.distributed cluster whose workers have this starpos and see the files",
    )


def _jobs(text: str) -> int:
    try:
        return 0 if text == AUTO else common.number(0, MOST_JOBS, int)(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is neither a whole number nor {AUTO}") from None


def workers_of(args: argparse.Namespace, frames: int) -> Workers:
    """No more processes than frames."""
    if args.scheduler is not None:
        if args.jobs is not None:
            raise InstrumentError("--scheduler names machines, --jobs processes of this one: give either")
        return Cluster(args.scheduler)
    number = min(processors() if args.jobs == 0 else args.jobs or 1, frames)
    return Here() if number <= 1 else Processes(number)


def watched(answers: Iterable, number: int) -> Iterator:
    """The same, with a bar where the answers themselves do not show how far it is."""
    bar = common.ProgressBar()
    for k, answer in enumerate(answers, 1):
        if not sys.stdout.isatty():
            bar(f"frame {k} of {number}", k / number)
        yield answer


def prepare(instrument: Instrument, about: About) -> None:
    """Have the triangles in the cache, where all processes of a machine find them."""
    solver = Solver(instrument, catalogue.load_catalogue(), progress=common.ProgressBar())
    with suppress(StarposError):  # which the frames will say
        solver.prepare(about.width, about.height)

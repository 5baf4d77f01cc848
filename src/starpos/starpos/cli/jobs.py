# SPDX-License-Identifier: Apache-2.0
"""Options for the processes or machines that work on the frames: --jobs and --scheduler."""

import argparse
import sys
from collections.abc import Iterable, Iterator
from contextlib import suppress

from starpos.cli import console, options
from starpos.errors import InstrumentError, StarposError
from starpos.fix.solver import Solver
from starpos.instrument.instrument import Instrument
from starpos.night.reading import About
from starpos.parallel.call import Here, Workers
from starpos.parallel.cluster import Cluster
from starpos.parallel.processes import Processes, processors
from starpos.sky import catalogue

MAX_JOBS = 1000
AUTO = "auto"


def add_jobs(parser: argparse.ArgumentParser, what: str = "frames") -> None:
    """Add the options that `workers_of` reads; what: the object of the work."""
    parser.add_argument(
        "-j",
        "--jobs",
        type=_jobs,
        metavar="N|auto",
        help=f"work {what} on this number of processes (1; auto or 0: one per processor)",
    )
    parser.add_argument(
        "--scheduler",
        metavar="ADDRESS",
        help="work them on a dask.distributed cluster whose workers have this starpos and see the files",
    )


def _jobs(text: str) -> int:
    try:
        return 0 if text == AUTO else options.number(0, MAX_JOBS, int)(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is neither a whole number nor {AUTO}") from None


def workers_of(args: argparse.Namespace, frames: int) -> Workers:
    """The workers that the options ask for, with no more processes than frames; raises InstrumentError."""
    if args.scheduler is not None:
        if args.jobs is not None:
            raise InstrumentError(
                "--scheduler names machines, --jobs processes of this one: give one of the two"
            )
        return Cluster(args.scheduler)
    number = min(processors() if args.jobs == 0 else args.jobs or 1, frames)
    return Here() if number <= 1 else Processes(number)


def watched(answers: Iterable, number: int, what: str = "frame", silent: bool = True) -> Iterator:
    """The answers unchanged, with a progress bar unless standard output shows them on the same terminal.

    silent: whether, without a terminal, the answers are lines that show the progress.
    """
    bar = console.ProgressBar(terminal_only=silent)
    for k, answer in enumerate(answers, 1):
        if not (silent and sys.stdout.isatty()):
            bar(f"{what} {k} of {number}", k / number)
        yield answer


def prepare(command: str, instrument: Instrument, about: About) -> None:
    """Put the tables of a field into the cache, for all processes of a machine; reports what the catalogue lacks."""
    solver = Solver(instrument, catalogue.load_catalogue(), progress=console.ProgressBar())
    # the frames report the error
    with suppress(StarposError):
        if thin := solver.prepare(about.width, about.height, about.origin_px):
            console.complain(command, thin)

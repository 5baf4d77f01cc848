# SPDX-License-Identifier: Apache-2.0
# PYTHON_ARGCOMPLETE_OK
"""The command `starpos`: the instrument without ROS, for a night that is on disk.  Each command has a file."""

import argparse
import io
import os
import re
import sys
import warnings
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from importlib import import_module
from typing import Any, NoReturn

from starpos import __version__
from starpos.errors import StarposError
from starpos.parallel import BLAS_THREADS

BAD_CALL = 2


@dataclass(frozen=True)
class Command:
    """A command for --help; `text` begins with a small letter and has no full stop."""

    text: str
    examples: tuple[str, ...]
    next_step: str

    @property
    def epilog(self) -> str:
        """The end of its --help."""
        examples = "".join(f"  {example}\n" for example in self.examples)
        return f"examples:\n{examples}\nnext: {self.next_step}"


COMMANDS = {
    "solve": Command(
        "position and heading of frames with their tilts",
        (
            "starpos simulate night && starpos solve night --misalignment 0 0 0 --misalignment-stddev 5 "
            "--inclinometer sca100t_calibrated",
            "starpos solve *.fits --tilt tilt.csv --focal-mm 600 --pixel-um 6.4 --self-calibrate --save instrument.yaml",
            "starpos solve *.fits --tilt tilt.csv --instrument instrument.yaml --near 35.7 51.4 --csv > places.csv",
        ),
        "starpos report draws the same night; starpos calibrate and --self-calibrate find A3",
    ),
    "navigate": Command(
        "position, heading and velocity of a voyage: frames and an IMU, while driving, sailing, flying",
        (
            "starpos navigate *.csv --imu imu.csv --focal-mm 16 --pixel-um 3.45",
            "starpos navigate *.fits --imu imu.csv --velocity wheels.csv --instrument instrument.yaml --json",
        ),
        "starpos solve, for an instrument that stands still",
    ),
    "detect": Command(
        "the stars of frames",
        (
            "starpos detect frame.fits",
            "starpos detect *.fits --csv > stars.csv",
        ),
        "starpos identify names them",
    ),
    "identify": Command(
        "where frames look, lost in space",
        (
            "starpos identify photo.jpg",
            "starpos identify *.fits --focal-mm 600 --pixel-um 6.4 --jobs auto --csv > where.csv",
        ),
        "starpos solve computes the position from frames with their tilts and times",
    ),
    "replay": Command(
        "solve recorded nights (rosbag2) with the solver's own code: the same fixes as in the running graph",
        (
            "starpos replay recorded_night",
            "starpos replay nights/* --params-file robot.yaml --jobs auto --json",
        ),
        "starpos report draws the same bags",
    ),
    "calibrate": Command(
        "A3 at a known place, or the camera, from identified stars",
        (
            "starpos calibrate *.fits --tilt tilt.csv --focal-mm 600 --pixel-um 6.4 --site 35.70 51.41 --output a3.yaml",
            "starpos calibrate *.fits --focal-mm 600 --pixel-um 6.4 --camera camera.yaml",
        ),
        "starpos solve --instrument with the file that was written",
    ),
    "deflection": Command(
        "deflection of the vertical at a known site, from a zenith camera's frames and tilts",
        (
            "starpos deflection *.fits --tilt tilt.csv --site 47.3 8.5 560 --instrument zenith.yaml --pressure-hpa 950 "
            "--temperature-c 12",
            "starpos deflection --plan 0.1 --site 47.3 8.5 560 --instrument zenith.yaml",
        ),
        "starpos stations and starpos report read what --json prints; docs/how-to/deflection.md has the whole way",
    ),
    "stations": Command(
        "many sessions of starpos deflection: repeats, differences from a geoid grid, levelling, GeoJSON",
        (
            "starpos deflection *.fits --tilt tilt.csv --site 47.3 8.5 560 --station P1 --instrument z.yaml --json > "
            "p1.json",
            "starpos stations p1.json p2.json --geoid egm96_15.gtx --level P1 P2",
            "starpos stations *.json --geojson > stations.geojson",
        ),
        "starpos report p1.json makes the station's page",
    ),
    "satellites": Command(
        "a position from satellites among the stars and their orbits, without a level",
        (
            "starpos satellites sightings.csv --elements active.tle --height 30 --height-stddev 20",
            "starpos satellites night.iod --elements elements --clock-stddev 0.5 --json",
        ),
        "docs/how-to/satellites.md has the method and where orbits are had",
    ),
    "report": Command(
        "nights on one page: stability, scatter, residuals, sky, error budget",
        (
            "starpos report night --misalignment 0 0 0 --misalignment-stddev 5 --inclinometer sca100t_calibrated "
            "-o my-report",
        ),
        "open the index.html whose path it prints",
    ),
    "simulate": Command(
        "write a night of frames and tilts from a place you choose",
        (
            "starpos simulate night",
            "starpos simulate turned -n 8 --turn 45 --stars-only --misalignment 1 -2 100 --latitude 47.3 --longitude 8.5",
        ),
        "starpos solve FOLDER, starpos report FOLDER; truth.json has the true values",
    ),
    "catalogue": Command(
        "build the star catalogue, or describe it and its triangles",
        (
            "starpos catalogue info",
            "starpos catalogue deepen --fetch",
        ),
        "starpos identify and starpos solve take the catalogue by themselves",
    ),
    "montecarlo": Command(
        "identify random fields, solve random nights, and count successes: the paper's tables",
        ("starpos montecarlo --fields 100", "starpos montecarlo nights --help"),
        "docs/the_paper.md compares the tables with the paper's",
    ),
    "first-night": Command(
        "focus, exposure, level, clock, the level's signs, then A3 by turning: step by step, live, until it is saved",
        (
            "starpos first-night NIGHT --focal-mm 600 --pixel-um 6.4 --save instrument.yaml",
            "starpos first-night NIGHT --save instrument.yaml --field night.zip",
        ),
        "starpos solve --instrument with the file that was written",
    ),
    "doctor": Command(
        "which parts that starpos needs this machine has, which are missing, and what to type",
        (
            "starpos doctor",
            "starpos doctor --live --json",
        ),
        "starpos simulate night, and starpos solve night",
    ),
}


class CommandParser(argparse.ArgumentParser):
    """A parser that prints one line for a bad call, as for any other error; -33:52:10 is a number, not an option."""

    def __init__(self, *args: Any, **about: Any) -> None:
        super().__init__(*args, **about)
        self._negative_number_matcher = re.compile(r"-\d[\d:]*(\.\d*)?$|-\.\d+$")

    def error(self, message: str) -> NoReturn:
        """Print the message and exit."""
        self.exit(BAD_CALL, f"{self.prog}: {message} (see {self.prog} --help)\n")


def _one_line_each(command: str) -> Callable[..., None]:
    """A warnings.showwarning that prints warnings like errors, each sentence once."""
    shown: set[str] = set()

    def show(message: Warning | str, *_about: object, **_more: object) -> None:
        text = " ".join(str(message).split())
        if text not in shown:
            shown.add(text)
            print(f"starpos {command}: {text}", file=sys.stderr)

    return show


def parser_for(given: Sequence[str]) -> CommandParser:
    """The parser of a call; of the commands only the one in use is imported, so that --help is quick."""
    parser = CommandParser(
        prog="starpos",
        description="Position and heading from the stars.",
        epilog="starpos COMMAND --help has examples. A first try: starpos doctor, then starpos simulate night. With "
        'argcomplete, eval "$(register-python-argcomplete starpos)" has the Tab key complete commands and options.',
    )
    parser.add_argument("--version", action="version", version=f"starpos {__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for name, command in COMMANDS.items():
        text = command.text
        sub = commands.add_parser(
            name,
            help=text,
            description=text[0].upper() + text[1:] + ".",
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        if given and given[0] == name:
            import_module(f"starpos.cli.{name.replace('-', '_')}").define(sub)
            sub.epilog = f"{sub.epilog}\n\n{command.epilog}" if sub.epilog else command.epilog
    return parser


def complete() -> None:
    """Answer the shell that asks, by argcomplete, how a line may go on; return if none asks."""
    line = os.environ.get("COMP_LINE")
    if line is None or "_ARGCOMPLETE" not in os.environ:
        return
    with suppress(ImportError):
        from argcomplete import autocomplete

        words = line[: int(os.environ.get("COMP_POINT", len(line)))].split()
        autocomplete(parser_for(words[1:]), exclude=["-h"])


def guard_surroundings() -> None:
    """Make any inherited environment and terminal do: letters that it lacks are escaped, no window is drawn in."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    # numpy and matplotlib, which read these, are loaded with the command; a notebook's backend is of no use here
    for name in BLAS_THREADS:
        os.environ.setdefault(name, "1")
    os.environ.pop("MPLBACKEND", None)


def drop_output() -> None:
    """Let what is still to be written go nowhere, so that the interpreter's end does not fail on it."""
    with suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def main(argv: list[str] | None = None) -> int:
    """Run one command; returns 0 for success, 1 for no result, 2 for a bad call, unreadable input or lost output."""
    complete()
    given = sys.argv[1:] if argv is None else argv
    guard_surroundings()
    try:
        args = parser_for(given).parse_args(given)
    except ModuleNotFoundError as e:
        print(
            f"starpos: the module {e.name} is not here: starpos doctor says what is missing", file=sys.stderr
        )
        return BAD_CALL
    try:
        with warnings.catch_warnings():
            warnings.showwarning = _one_line_each(args.command)
            # PYTHONWARNINGS may make errors of them
            if sys.warnoptions:
                warnings.simplefilter("default")
            status: int = args.run(args)
        # a reader that has gone must be noticed here, and not while the interpreter ends
        sys.stdout.flush()
        return status
    except StarposError as e:
        print(f"starpos {args.command}: {e}", file=sys.stderr)
        return BAD_CALL
    # the reader of our output has gone, as in `starpos ... | head`
    except BrokenPipeError:
        drop_output()
        return 0
    except OSError as e:
        # an error of a file names it
        if e.filename is not None:
            raise
        drop_output()
        print(f"starpos {args.command}: its output cannot be written ({e.strerror})", file=sys.stderr)
        return BAD_CALL
    except KeyboardInterrupt:
        return 130

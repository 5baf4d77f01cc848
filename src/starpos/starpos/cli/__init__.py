# SPDX-License-Identifier: Apache-2.0
"""The command `starpos`: the instrument without ROS, for a night that is on disk.  Each command has a file."""

import argparse
import os
import sys
import warnings
from collections.abc import Callable
from importlib import import_module
from typing import NoReturn

from starpos import __version__
from starpos.errors import StarposError
from starpos.parallel import BLAS_THREADS

COMMANDS = {
    "solve": "position and heading of frames with their tilts",
    "navigate": "position, heading and velocity of a voyage: frames and an IMU, while driving, sailing, flying",
    "detect": "the stars of frames",
    "identify": "where frames look, lost in space",
    "replay": "recorded nights (rosbag2) by the solver's own code: the same fixes as in the running graph",
    "calibrate": "A3 at a known place, or the camera, from identified stars",
    "report": "nights on one page: stability, scatter, residuals, sky, error budget",
    "simulate": "write a night of frames and tilts from a place you choose",
    "catalogue": "build the star catalogue, or say what it and its triangles hold",
    "montecarlo": "identify random fields and work random nights, and count: the paper's tables",
}
BAD_CALL = 2


class CommandParser(argparse.ArgumentParser):
    """A parser that prints one line for a bad call, as for any other error."""

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


def main(argv: list[str] | None = None) -> int:
    """Run one command; returns 0 for success, 1 for no result, 2 for a bad call or unreadable input."""
    parser = CommandParser(prog="starpos", description="Position and heading from the stars.")
    parser.add_argument("--version", action="version", version=f"starpos {__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    given = sys.argv[1:] if argv is None else argv
    # numpy, which reads these, is loaded with the command
    for name in BLAS_THREADS:
        os.environ.setdefault(name, "1")
    for name, text in COMMANDS.items():
        sub = commands.add_parser(name, help=text, description=text[0].upper() + text[1:] + ".")
        # only the command in use is imported, so that --help is quick
        if given and given[0] == name:
            import_module(f"starpos.cli.{name}").define(sub)
    args = parser.parse_args(given)
    try:
        with warnings.catch_warnings():
            warnings.showwarning = _one_line_each(args.command)
            status: int = args.run(args)
        # a reader that has gone must be noticed here, and not while the interpreter ends
        sys.stdout.flush()
        return status
    except StarposError as e:
        print(f"starpos {args.command}: {e}", file=sys.stderr)
        return BAD_CALL
    # the reader of our output has gone, as in `starpos ... | head`
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except KeyboardInterrupt:
        return 130

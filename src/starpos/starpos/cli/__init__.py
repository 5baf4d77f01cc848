# SPDX-License-Identifier: Apache-2.0
"""`starpos`: the instrument without ROS, so that a night can be worked off a disk.  One file a command."""

import argparse
import os
import sys
import warnings
from importlib import import_module

from starpos import __version__
from starpos.errors import StarposError
from starpos.parallel import BLAS_THREADS

COMMANDS = {
    "solve": "position and heading of frames with their tilts",
    "detect": "the stars of frames",
    "identify": "where frames look, lost in space",
    "calibrate": "A3 at a known place, or the camera, from identified stars",
    "report": "nights on one page: stability, scatter, residuals, sky, error budget",
    "simulate": "write a night of frames and tilts from a place you choose",
    "catalogue": "build the star catalogue, or say what it and its triangles hold",
    "montecarlo": "identify random fields and work random nights, and count: the paper's tables",
}
BAD_CALL = 2


class CommandParser(argparse.ArgumentParser):
    """One line for a bad call, as for any other error."""

    def error(self, message: str):
        self.exit(BAD_CALL, f"{self.prog}: {message} (see {self.prog} --help)\n")


def _one_line_each(command: str):
    """A warnings.showwarning that prints as any error is printed, and each sentence once."""
    shown = set()

    def show(message, *_about, **_more):
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
    for name in BLAS_THREADS:  # a command is what loads numpy
        os.environ.setdefault(name, "1")
    for name, text in COMMANDS.items():
        sub = commands.add_parser(name, help=text, description=text[0].upper() + text[1:] + ".")
        if given and given[0] == name:  # only the command in use is imported: --help stays quick
            import_module(f"starpos.cli.{name}").define(sub)
    args = parser.parse_args(given)
    try:
        with warnings.catch_warnings():
            warnings.showwarning = _one_line_each(args.command)
            status = args.run(args)
        sys.stdout.flush()  # here, where a reader that has gone is expected, and not while the interpreter ends
        return status
    except StarposError as e:
        print(f"starpos {args.command}: {e}", file=sys.stderr)
        return BAD_CALL
    except BrokenPipeError:  # the reader of our output has gone, as in `starpos ... | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except KeyboardInterrupt:
        return 130

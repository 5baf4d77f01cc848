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
from importlib import import_module
from pathlib import Path
from typing import Any, NoReturn

from starpos import __version__
from starpos.errors import FixError, StarposError
from starpos.parallel import BLAS_THREADS

# exit status: no answer; a bad call, or input that cannot be read
NOTHING, BAD_CALL = 1, 2
# the commands in the order of --help, which needs nothing else of them
COMMANDS = dict(
    line.split(": ", 1)
    for line in Path(__file__).with_name("data").joinpath("commands.txt").read_text("utf-8").splitlines()[1:]
)


class CommandParser(argparse.ArgumentParser):
    """A parser that prints one line for a bad call, as for any other error; -33:52:10 is a number, not an option."""

    def __init__(self, *args: Any, **about: Any) -> None:
        super().__init__(*args, **about)
        self._negative_number_matcher = re.compile(r"-\d[\d:]*(\.\d*)?$|-\.\d+$")

    def error(self, message: str) -> NoReturn:
        """Print the message and exit."""
        self.exit(BAD_CALL, f"{self.prog}: {message} (see {self.prog} --help)\n")


def _one_line_each(complain: Callable[[str], None]) -> Callable[..., None]:
    """A warnings.showwarning that complains of each sentence once."""
    shown: set[str] = set()

    def show(message: Warning | str, *_about: object, **_more: object) -> None:
        text = " ".join(str(message).split())
        if text not in shown:
            shown.add(text)
            complain(text)

    return show


def parser_for(given: Sequence[str]) -> CommandParser:
    """The parser of a call: of the command in use alone, or of all commands' names, so that it is made quickly."""
    parser = CommandParser(
        prog="starpos",
        description="Position and heading from the stars.",
        epilog="starpos COMMAND --help has examples. A first try: starpos doctor, then starpos simulate night. With "
        'argcomplete, eval "$(register-python-argcomplete starpos)" has the Tab key complete commands and options.',
    )
    parser.add_argument("--version", action="version", version=f"starpos {__version__}")
    choice = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    if given and given[0] in COMMANDS:
        sub = choice.add_parser(given[0], help=COMMANDS[given[0]])
        import_module("starpos.cli.commands").command_of(given[0]).define(sub)
    else:
        for name, text in COMMANDS.items():
            choice.add_parser(name, help=text)
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
        run = run_of(args)
        # it loads numpy, as commands do
        console = import_module("starpos.cli.console")
    except ModuleNotFoundError as e:
        print(
            f"starpos: the module {e.name} is not here: starpos doctor says what is missing", file=sys.stderr
        )
        return BAD_CALL
    with console.speaking(args.command):
        return _run(args, run, console.complain)


def run_of(args: argparse.Namespace) -> Callable[[argparse.Namespace], int]:
    """The function of a call, of the command's module: `run`, for a kind of the command `run_KIND`."""
    module = import_module(f"starpos.cli.{args.command.replace('-', '_')}")
    kind = getattr(args, "kind", None)
    return getattr(module, "run" if kind is None else f"run_{kind}")


def _run(
    args: argparse.Namespace, run: Callable[[argparse.Namespace], int], complain: Callable[[object], None]
) -> int:
    try:
        with warnings.catch_warnings():
            warnings.showwarning = _one_line_each(complain)
            # PYTHONWARNINGS may make errors of them
            if sys.warnoptions:
                warnings.simplefilter("default")
            # not for each command: it loads what reads instruments
            if getattr(args, "instrument", None) is not None:
                import_module("starpos.cli.options").fill_site(args)
            import_module("starpos.cli.commands").check_call(args)
            status = run(args)
        # a reader that has gone must be noticed here, and not while the interpreter ends
        sys.stdout.flush()
        return status
    except StarposError as e:
        complain(e)
        # stars that do not support a fix are no bad input
        return NOTHING if isinstance(e, FixError) else BAD_CALL
    # the reader of our output has gone, as in `starpos ... | head`
    except BrokenPipeError:
        drop_output()
        return 0
    except OSError as e:
        # an error of a file names it
        if e.filename is not None:
            raise
        drop_output()
        complain(f"its output cannot be written ({e.strerror})")
        return BAD_CALL
    except KeyboardInterrupt:
        return 130

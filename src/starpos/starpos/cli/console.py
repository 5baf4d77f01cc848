# SPDX-License-Identifier: Apache-2.0
"""What commands print: answers as lines, JSON or CSV, complaints, progress; and their exit status."""

import argparse
import csv
import json
import math
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import Any

import numpy as np

from starpos import cli
from starpos.errors import named
from starpos.files import rows_of

OUTPUTS = Path(__file__).with_name("data") / "outputs.yaml"
NOTHING, UNREADABLE = cli.NOTHING, cli.BAD_CALL
# s of work that needs no bar
BAR_AFTER_S = 0.5


def print_json(value: dict) -> None:
    """Print an object on one line; NaN and infinity become null."""
    print(json.dumps(plain(value)), flush=True)


def tell(args: argparse.Namespace, value: dict, line: str) -> None:
    """Print an answer: as an object where --json asks for it, else the same for people."""
    if args.json:
        print_json(value)
    else:
        print(line, flush=True)


def values(of: object, names: str) -> dict:
    """Attributes of an object by their names, as the object of --json has them too."""
    return {name: getattr(of, name) for name in names.split()}


def plain(value: Any) -> Any:
    """The value of types that json knows, without NaN and infinity."""
    if isinstance(value, dict):
        return {k: plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple, np.ndarray)):
        return [plain(v) for v in value]
    if isinstance(value, (float, np.floating)):
        return float(value) if math.isfinite(value) else None
    if isinstance(value, np.integer):
        return int(value)
    return value


# the command that complains
_speaking: ContextVar[str] = ContextVar("speaking", default="")


@contextmanager
def speaking(command: str) -> Iterator[None]:
    """Have complaints begin with the name of a command."""
    before = _speaking.set(command)
    try:
        yield
    finally:
        _speaking.reset(before)


def complain(*said: object) -> None:
    """Print lines on standard error, as the command's: errors, remarks or sentences; for '' and None none."""
    for each in filter(None, said):
        # clears a progress bar
        if sys.stderr.isatty():
            print("\r\x1b[K", end="", file=sys.stderr)
        print(f"starpos {_speaking.get()}: {each}", file=sys.stderr)


def complain_of(night: str | None, *said: object) -> None:
    """Complain about a night; None where it is not named."""
    complain(*(each if night is None else f"{night}: {each}" for each in said if each))


class FrameComplaints:
    """Complains about frames: a sentence that is true of several, but for their names, is printed once."""

    def __init__(self) -> None:
        self._frames: dict[str, list[str]] = {}

    def __call__(self, name: str, error: object) -> None:
        """Complain about a frame, unless the same was said about another."""
        reason = str(error).replace(name, "")
        alike = self._frames.setdefault(reason, [])
        alike.append(name)
        if len(alike) == 1:
            complain(named(name, error))

    def end(self) -> None:
        """Say how many more frames each sentence is true of."""
        for reason, (first, *others) in self._frames.items():
            if others:
                start = reason.lstrip(": ")[:60].rsplit(" ", 1)[0]
                last = f", the last is {others[-1]}" if len(others) > 1 else ""
                frames = "1 more frame" if len(others) == 1 else f"{len(others)} more frames"
                complain(f"the same as of {first} ({start} ...) is true of {frames}{last}")


class ProgressBar:
    """Progress on standard error, if it is a terminal: a bar for work of more than BAR_AFTER_S."""

    def __init__(self) -> None:
        self.begin = time.monotonic()

    def __call__(self, what: str, done: float) -> None:
        if time.monotonic() - self.begin < BAR_AFTER_S or not sys.stderr.isatty():
            return
        from multiprocessing import parent_process

        # several processes would write over each other's
        if parent_process() is not None:
            return
        filled = int(30 * min(done, 1.0))
        end = "\n" if done >= 1 else ""
        print(
            f"\r{what:>20} [{'#' * filled}{'.' * (30 - filled)}] {100 * done:3.0f} %",
            end=end,
            file=sys.stderr,
            flush=True,
        )


class Output:
    """Writes one answer after another; the first line describes them, except in JSON.

    kind: a row of data/outputs.yaml.  answers: all that were written.
    """

    def __init__(self, args: argparse.Namespace, kind: str) -> None:
        self._json, self._head = args.json, rows_of(OUTPUTS)[kind].get("head", "")
        self.columns = columns_of(kind)
        self._rows = csv.DictWriter(sys.stdout, self.columns, extrasaction="ignore", lineterminator="\n")
        self._csv, self._begun = args.csv, False
        self.answers: list[dict] = []

    def put(self, value: dict, line: str, rows: Sequence[dict] | None = None) -> None:
        """Write an answer; line: the same for people, of one or more lines, or none; rows: if it is not one of a CSV."""
        self.answers.append(value)
        if self._json:
            print_json(value)
        elif self._csv:
            if not self._begun:
                self._rows.writeheader()
            for row in [value] if rows is None else rows:
                self._rows.writerow({k: _cell(v) for k, v in plain(row).items()})
            sys.stdout.flush()
        elif line:
            if self._head and not self._begun:
                print(self._head)
            print(line, flush=True)
        self._begun |= self._csv or bool(line)


def columns_of(kind: str) -> Sequence[str]:
    """The columns of --csv of a kind of output."""
    columns: Sequence[str] = rows_of(OUTPUTS)[kind]["columns"]
    return columns


def _cell(value: object) -> object:
    """A value of JSON in a CSV; several words are joined by spaces."""
    return " ".join(map(str, value)) if isinstance(value, list) else value

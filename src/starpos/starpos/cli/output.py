# SPDX-License-Identifier: Apache-2.0
"""Standard output of a command: a table for people, JSON objects, or CSV rows, by its options."""

import argparse
import csv
import sys
from collections.abc import Sequence

from starpos.cli import console


def add_formats(parser: argparse.ArgumentParser, json_help: str, csv_help: str | None) -> None:
    """Add --json and, with a help for it, --csv."""
    formats = parser.add_mutually_exclusive_group()
    formats.add_argument("--json", action="store_true", help=json_help)
    if csv_help is not None:
        formats.add_argument("--csv", action="store_true", help=csv_help)


class Output:
    """Writes one answer after another; the first line describes them, except in JSON.

    columns: keys of the answers that are columns of the CSV.  head: the first line for people.
    """

    def __init__(self, args: argparse.Namespace, columns: Sequence[str], head: str) -> None:
        self._json, self._head = args.json, head
        self._rows = csv.DictWriter(sys.stdout, columns, extrasaction="ignore", lineterminator="\n")
        self._csv, self._begun = args.csv, False

    def put(self, value: dict, line: str, rows: Sequence[dict] | None = None) -> None:
        """Write an answer; line: the same for people, of one or more lines, or none; rows: if it is not one of a CSV."""
        if self._json:
            console.print_json(value)
        elif self._csv:
            if not self._begun:
                self._rows.writeheader()
            for row in [value] if rows is None else rows:
                self._rows.writerow({k: _cell(v) for k, v in console.plain(row).items()})
            sys.stdout.flush()
        elif line:
            if self._head and not self._begun:
                print(self._head)
            print(line, flush=True)
        self._begun |= self._csv or bool(line)


def _cell(value: object) -> object:
    """A value of JSON in a CSV; several words are joined by spaces."""
    return " ".join(map(str, value)) if isinstance(value, list) else value

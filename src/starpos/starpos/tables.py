# SPDX-License-Identifier: Apache-2.0
"""CSV tables of numbers: the columns of each kind are declared once, and read into arrays by one set of rules."""

import csv
import io
import math
import os
import warnings
from array import array
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path

import numpy as np

from starpos.errors import StarposError, TimeError, one_line
from starpos.files import open_regular
from starpos.units import unix_of


def packaged(package: str, name: str) -> list[dict[str, str]]:
    """Rows of a CSV in the folder `data` of a package; lines that begin with # are remarks."""
    text = resources.files(package).joinpath("data", name).read_text("utf-8")
    return list(csv.DictReader(line for line in text.splitlines() if not line.startswith("#")))


# similarity from which an unknown column's name may be meant for a known one
ALIKE_NAME = 0.7


@dataclass(frozen=True, eq=False)
class Table:
    """The N rows of a table: its columns (N,) by name, and the rows' lines (N,) in the file.

    An empty cell is NaN. A column that is not needed is absent if the table has none.
    """

    columns: Mapping[str, np.ndarray]
    lines: np.ndarray

    def column(self, name: str, default: float = math.nan) -> np.ndarray:
        """A column (N,), or the default in each row."""
        return self.columns.get(name, np.full(len(self.lines), default))


@dataclass(frozen=True, kw_only=True)
class TableForm:
    """What a kind of table holds: a line of names in any order and case, and rows of numbers.

    what    names the kind in messages      error   is raised, with one sentence, where a table cannot be used
    limits  of a column's cells, each inclusive; a needed column with limits has no empty cell
    times   columns of ISO 8601 times, which become Unix seconds
    broken_rows_are_nan   otherwise a row that is not all numbers, or not as long as the line of names, is an error
    """

    what: str
    error: type[StarposError]
    needed: tuple[str, ...]
    optional: tuple[str, ...] = ()
    limits: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    most_bytes: int = 300_000_000
    broken_rows_are_nan: bool = False
    may_be_empty: bool = False
    times: tuple[str, ...] = ()

    @property
    def cure(self) -> str:
        """Advice on an unusable table."""
        more = f"[,{','.join(self.optional)}]" if self.optional else ""
        return f"give a CSV with a line of names, {','.join(self.needed)}{more}, and rows of numbers"

    def read(self, path: Path | str) -> Table:
        """Read a table from a file. Other columns than the form's are not read."""
        try:
            with io.TextIOWrapper(open_regular(path), "utf-8-sig") as text:
                if os.fstat(text.fileno()).st_size > self.most_bytes:
                    raise ValueError(f"it is larger than {self.most_bytes // 10**6} MB")
                return self.read_text(text, f"{path}")
        except FileNotFoundError:
            raise self.error(f"{path}: there is no such file: {self.cure}") from None
        except UnicodeDecodeError:
            raise self.error(
                f"{path}: not a readable {self.what} (it is not a text file): {self.cure}"
            ) from None
        except (OSError, ValueError) as e:
            reason = getattr(e, "strerror", None) or one_line(e)
            raise self.error(f"{path}: not a readable {self.what} ({reason}): {self.cure}") from None

    def read_text(self, text: io.TextIOBase, place: str, before: int = 0) -> Table:
        """Read a table from the rest of a text, of which some lines came before; `place` names it in messages."""
        names = [name.strip('" \t\r\n').lower() for name in text.readline().lstrip("# ").split(",")]
        self._check_names(names, place)
        used = {name: names.index(name) for name in (*self.needed, *self.optional) if name in names}
        start = text.tell()
        numbers = array("I")
        # quickest first: numbers alone; with empty cells, lines of comment or texts in other columns
        if (rows := _plain(text, len(names))) is not None:
            rows = rows[:, list(used.values())]
            numbers.extend(range(before + 2, before + 2 + len(rows)))
        else:
            text.seek(start)
            cells = self._cells(_rows(text, numbers, before + 2), used, len(names))
            try:
                rows = np.fromiter(cells, float)
            except UnicodeDecodeError:
                raise
            except ValueError as e:
                raise self.error(f"{place}:{numbers[-1]}: {one_line(e)}: {self.cure}") from None
        rows = rows.reshape(-1, len(used))
        if len(rows) == 0 and not self.may_be_empty:
            raise self.error(f"{place}: the {self.what} has no rows: {self.cure}")
        table = Table(dict(zip(used, rows.T, strict=True)), np.array(numbers))
        self._check_limits(table, place)
        return table

    def _check_names(self, names: list[str], place: str) -> None:
        lacking = [name for name in self.needed if name not in names]
        lacking += [name for name in (*self.needed, *self.optional) if names.count(name) > 1]
        if lacking:
            raise self.error(
                f"{place}: not a readable {self.what} (it has no column {lacking[0]}, or two): {self.cure}"
            )
        for name in set(names) - {*self.needed, *self.optional}:
            from difflib import get_close_matches

            for meant in get_close_matches(name, self.optional, 1, ALIKE_NAME):
                raise self.error(
                    f"{place}: its column {name} is not read: call it {meant} if it holds that, else give it "
                    f"another name"
                )

    def _cells(self, lines: Iterable[str], used: Mapping[str, int], width: int) -> Iterator[float]:
        """The cells that are used, row by row, of a table that is not all plain numbers; ValueError at a broken row."""
        for line in lines:
            try:
                row = next(csv.reader([line]))
                if len(row) != width:
                    raise ValueError(f"the row has not as many cells as there are columns ({width})")
                values = [
                    (_time if name in self.times else _number)(row[k], name) for name, k in used.items()
                ]
            except (ValueError, csv.Error) as e:
                if not self.broken_rows_are_nan:
                    raise ValueError(e) from None
                values = [math.nan] * len(used)
            yield from values

    def _check_limits(self, table: Table, place: str) -> None:
        for name, values in table.columns.items():
            low, high = self.limits.get(name, (-math.inf, math.inf))
            empty = np.isnan(values)
            wrong = ~(empty | ((values >= low) & (values <= high)))
            if name in self.limits and name in self.needed:
                wrong |= empty
            for k in np.flatnonzero(wrong)[:1]:
                said = "empty" if empty[k] else f"{values[k]:.10g}"
                raise self.error(
                    f"{place}:{table.lines[k]}: {name} is {said}: give a number from {low:g} to {high:g}"
                )


def _plain(text: io.TextIOBase, width: int) -> np.ndarray | None:
    """The cells (N, width) of the rest of a text, if each of its lines is a row of numbers; else None."""
    start = text.tell()
    try:
        with warnings.catch_warnings():
            # our own error says that a table is empty
            warnings.simplefilter("ignore")
            rows = np.loadtxt(text, delimiter=",", comments=None, ndmin=2)
    except ValueError:
        return None
    text.seek(start)
    return rows if rows.shape == (sum(1 for _ in text), width) else None


def _rows(text: Iterable[str], numbers: array, first: int) -> Iterator[str]:
    """The lines that have a row; their numbers are appended to `numbers`."""
    for number, line in enumerate(text, first):
        if line.strip(", \t\r\n") and not line.startswith("#"):
            numbers.append(number)
            yield line


def _number(cell: str, name: str) -> float:
    try:
        return float(cell) if cell.strip() else math.nan
    except ValueError:
        raise ValueError(f"{name} is {one_line(repr(cell))}, which is no number") from None


def _time(cell: str, name: str) -> float:
    try:
        return unix_of(cell.strip()) if cell.strip() else math.nan
    except TimeError as e:
        raise ValueError(f"{name}: {e}") from None

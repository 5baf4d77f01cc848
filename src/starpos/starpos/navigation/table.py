# SPDX-License-Identifier: Apache-2.0
"""Tables of a voyage on disk: a CSV of numbers in the order of time."""

import io
import os
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from starpos.errors import VoyageError, one_line
from starpos.files import open_regular

# a night of 400 Hz
MAX_BYTES = 1_500_000_000
TIME = "utc_unix_s"
# Unix times of the years 1973 to 2100
EARLIEST_S, LATEST_S = 9.4e7, 4.1e9


@dataclass(frozen=True, eq=False)
class Record:
    """Rows of a table that can be used, in order of time: times (N,), values (N, C), and a sentence for each fault."""

    utc_unix_s: np.ndarray
    values: np.ndarray
    faults: tuple[str, ...]


def read_record(path: Path | str, columns: Sequence[str], what: str) -> Record:
    """Read the columns of a CSV whose first line names them, utc_unix_s first; VoyageError if it cannot be used.

    Rows that are not all finite numbers are left out, and so are rows whose time does not come after all before them:
    of two readings with one stamp it is unknown which is right.
    """
    cure = f"give a CSV with a line of names, {','.join((TIME, *columns))}, and a row a reading"
    try:
        with open_regular(path) as file:
            if os.fstat(file.fileno()).st_size > MAX_BYTES:
                raise ValueError(f"it is larger than {MAX_BYTES // 10**6} MB")
            text = io.TextIOWrapper(file, "utf-8-sig")
            names = [name.strip() for name in text.readline().lstrip("# ").split(",")]
            lacking = [name for name in (TIME, *columns) if names.count(name) != 1]
            if lacking:
                raise ValueError(f"it has no column {lacking[0]}, or two")
            with warnings.catch_warnings():
                # our own error says that a table is empty
                warnings.simplefilter("ignore")
                rows = np.loadtxt(
                    text, delimiter=",", ndmin=2, usecols=[names.index(name) for name in (TIME, *columns)]
                )
    except FileNotFoundError:
        raise VoyageError(f"{path}: there is no such file: {cure}") from None
    except (OSError, ValueError, UnicodeDecodeError) as e:
        reason = getattr(e, "strerror", None) or one_line(e)
        raise VoyageError(f"{path}: not a readable table of {what} ({reason}): {cure}") from None
    if len(rows) == 0:
        raise VoyageError(f"{path}: the table of {what} has no rows: {cure}")
    return in_order(rows[:, 0], rows[:, 1:], f"{path}")


def in_order(utc_unix_s: np.ndarray, values: np.ndarray, place: str) -> Record:
    """Keep the rows that can be used, as `read_record` says; VoyageError if none can."""
    faults = []
    sound = np.isfinite(values).all(1) & np.isfinite(utc_unix_s)
    sound &= (utc_unix_s > EARLIEST_S) & (utc_unix_s < LATEST_S)
    if not sound.all():
        faults.append(
            f"{place}: {_rows(~sound)} without a finite number in each cell, or a time of 1973 to 2100: left out"
        )
    t, v = utc_unix_s[sound], values[sound]
    late = t > np.maximum.accumulate(np.concatenate([[-np.inf], t]))[:-1]
    if not late.all():
        faults.append(
            f"{place}: {_rows(~late)} not later than all before: their times go back or are doubled; left out"
        )
    if not late.any():
        raise VoyageError(f"{place}: no row can be used: it needs a time in Unix s and finite numbers")
    return Record(t[late], v[late], tuple(faults))


def _rows(wrong: np.ndarray) -> str:
    number = int(wrong.sum())
    return f"{number} row is" if number == 1 else f"{number} rows are"

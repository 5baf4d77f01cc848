# SPDX-License-Identifier: Apache-2.0
"""Tables of a star catalogue that are built once and kept in a cache on the disk, from which they are memory-mapped."""

import os
import shutil
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import fields
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from starpos.units import DAY_S

SCRATCH = "unfinished-"
Table = TypeVar("Table")


def cache_folder() -> Path:
    """The folder where tables of the catalogue are kept: $XDG_CACHE_HOME/starpos, by default ~/.cache/starpos."""
    given = os.environ.get("XDG_CACHE_HOME")
    try:
        return Path(given or Path.home() / ".cache") / "starpos"
    # a user without a home, as in some containers
    except RuntimeError:
        return Path(tempfile.gettempdir()) / f"starpos-{os.getuid()}"


def load_or_build(
    folder: Path, prefix: str, load: Callable[[], Table | None], build: Callable[[], Table], what: str
) -> Table:
    """The table that `load` maps from a folder of the cache; built and kept there if it is missing or broken.

    prefix: of the folder's name, KIND-FORMAT-; folders of other formats are removed.
    what: name of the table in a warning if it cannot be kept; '' for a table that is quick to build, without a warning.
    """
    if (stored := load()) is not None:
        return stored
    with _one_builder(folder.parent):
        # another process may have been first
        if (stored := load()) is not None:
            return stored
        built = build()
        try:
            _store(built, folder, prefix)
        except OSError as e:
            if what:
                warnings.warn(
                    f"{folder.parent}: {what} cannot be kept there ({e.strerror}), so that each start builds them again: "
                    "make the folder writable or set XDG_CACHE_HOME",
                    stacklevel=3,
                )
            return built
        # the mapped table takes its place in memory
        del built
    return load() or build()


def mapped(
    kind: type,
    folder: Path,
    number_kinds: str,
    newer: Callable[[dict[str, np.ndarray]], dict[str, np.ndarray]] = lambda columns: {},
) -> Any | None:
    """The table, a dataclass of arrays, memory-mapped; None if a column is missing or not of its kind of numbers.

    newer: makes the columns that folders of earlier versions lack, from the others.
    """
    try:
        columns = {
            path.stem: np.asarray(np.load(path, mmap_mode="r", allow_pickle=False))
            for f in fields(kind)
            if (path := folder / f"{f.name}.npy").exists()
        }
        names = [f.name for f in fields(kind)]
        if len(columns) < len(names):
            columns = {**newer(columns), **columns}
        ordered = {name: columns[name] for name in names}
    except (OSError, ValueError, EOFError, KeyError):
        return None
    return kind(**ordered) if [c.dtype.kind for c in ordered.values()] == list(number_kinds) else None


def rising(start: np.ndarray, end: int) -> bool:
    """Whether these are the first rows of bins of a number of rows."""
    return bool(start[0] == 0 and start[-1] == end and np.all(np.diff(start) >= 0))


@contextmanager
def _one_builder(cache: Path) -> Iterator[None]:
    """Let one process build in the cache while others wait, if folders can be locked; a killed process holds no lock."""
    folder = None
    with suppress(OSError, ImportError):
        import fcntl

        cache.mkdir(parents=True, exist_ok=True)
        folder = os.open(cache, os.O_RDONLY)
        fcntl.flock(folder, fcntl.LOCK_EX)
    try:
        yield
    finally:
        if folder is not None:
            os.close(folder)


def _store(table: Any, folder: Path, prefix: str) -> None:
    """Write all columns into a new folder, then rename it, so that all of it is there or nothing."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    _clear(folder.parent, prefix)
    with tempfile.TemporaryDirectory(dir=folder.parent, prefix=SCRATCH) as scratch:
        whole = Path(scratch) / "whole"
        whole.mkdir()
        for f in fields(table):
            with open(whole / f"{f.name}.npy", "wb") as file:
                np.save(file, getattr(table, f.name))
                file.flush()
                os.fsync(file.fileno())
        # it would have been used if it were whole
        if folder.exists():
            folder.rename(Path(scratch) / "broken")
        try:
            whole.rename(folder)
        except OSError:
            # if the folder is there now, another process was first
            if not folder.is_dir():
                raise


def _clear(cache: Path, prefix: str) -> None:
    """Remove the folders of earlier formats, and unfinished ones that are older than a day."""
    for old in cache.glob(f"{prefix.partition('-')[0]}-*"):
        if not old.name.startswith(prefix):
            shutil.rmtree(old, ignore_errors=True)
    for left in cache.glob(f"{SCRATCH}*"):
        with suppress(OSError):
            if time.time() - left.stat().st_mtime > DAY_S:
                shutil.rmtree(left, ignore_errors=True)

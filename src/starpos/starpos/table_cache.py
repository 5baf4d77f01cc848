# SPDX-License-Identifier: Apache-2.0
"""Tables of a star catalogue that are built once and kept in a cache on the disk, from which they are memory-mapped."""

import hashlib
import os
import shutil
import tempfile
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import fields
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np

from starpos.units import DAY_S

SCRATCH = "unfinished-"
Table = TypeVar("Table")


def cache_folder() -> Path:
    """The folder where tables of the catalogue are kept: $XDG_CACHE_HOME/starpos, by default ~/.cache/starpos."""
    given = os.environ.get("XDG_CACHE_HOME")
    try:
        return Path(given or Path.home() / ".cache") / "starpos"
    # a user without a home, as in some containers; Windows numbers no users
    except RuntimeError:
        return Path(tempfile.gettempdir()) / f"starpos-{getattr(os, 'getuid', lambda: 'user')()}"


class KeptTables(Generic[Table]):
    """Tables of one kind, dataclasses of arrays with a method `check`: in the cache, and the last few in memory too.

    prefix        of the folders' names, KIND-FORMAT-; folders of other formats are removed
    number_kinds  numpy's kinds of the columns' numbers
    what          name of the table in a warning if it cannot be kept; '' for one that is quick to build
    most          number of tables in memory
    """

    def __init__(
        self, kind: type[Table], prefix: str, number_kinds: str, what: str = "", most: int = 1
    ) -> None:
        self.kind, self.prefix, self.number_kinds = kind, prefix, number_kinds
        self.what, self.most = what, most
        self._lock = threading.Lock()
        self._in_use: dict[Path, Table] = {}

    def folder(self, name: str) -> Path:
        """The folder of a table in the cache."""
        return cache_folder() / f"{self.prefix}{name}"

    def forget(self) -> None:
        """Let go of the tables in memory."""
        self._in_use.clear()

    def stored(self, name: str, *of: Any) -> Table | None:
        """The table of a name; None if it was not built, or is broken: `check(*of)` raises ValueError."""
        folder = self.folder(name)
        with self._lock:
            if folder not in self._in_use and (found := self.mapped(folder, *of)) is not None:
                self._keep(folder, found)
            return self._in_use.get(folder)

    def built(self, name: str, build: Callable[[], Table], *of: Any, anew: bool = False) -> Table:
        """The table of a name; built and kept in the cache if it is missing or broken, or wanted anew."""
        folder = self.folder(name)
        with self._lock:
            if anew or folder not in self._in_use:
                self._in_use.pop(folder, None)
                self._keep(folder, self._load_or_build(folder, build, of, anew))
            return self._in_use[folder]

    def _keep(self, folder: Path, table: Table) -> None:
        while len(self._in_use) >= self.most:
            self._in_use.pop(next(iter(self._in_use)))
        self._in_use[folder] = table

    def _load_or_build(self, folder: Path, build: Callable[[], Table], of: tuple, anew: bool) -> Table:
        if not anew and (stored := self.mapped(folder, *of)) is not None:
            return stored
        with _one_builder(folder.parent):
            # another process may have been first
            if not anew and (stored := self.mapped(folder, *of)) is not None:
                return stored
            built = build()
            try:
                _store(built, folder, self.prefix)
            except OSError as e:
                if self.what:
                    warnings.warn(
                        f"{folder.parent}: {self.what} cannot be kept there ({e.strerror}), so that each start builds "
                        "them again: make the folder writable or set XDG_CACHE_HOME",
                        stacklevel=4,
                    )
                return built
            # the mapped table takes its place in memory
            del built
        stored = self.mapped(folder, *of)
        return build() if stored is None else stored

    def mapped(self, folder: Path, *of: Any) -> Table | None:
        """The table in a folder, memory-mapped; None if a column is missing, of another kind, or does not fit."""
        names = [f.name for f in fields(self.kind)]  # type: ignore[arg-type]
        try:
            columns = {
                name: np.asarray(np.load(folder / f"{name}.npy", mmap_mode="r", allow_pickle=False))
                for name in names
            }
            if [c.dtype.kind for c in columns.values()] != list(self.number_kinds):
                return None
            table: Any = self.kind(**columns)
            table.check(*of)
        except (OSError, ValueError, EOFError, KeyError):
            return None
        return table  # type: ignore[no-any-return]


def digest_of(settings: object) -> str:
    """A digest of settings, of which a table's name is made."""
    return hashlib.sha256(repr(settings).encode()).hexdigest()[:16]


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

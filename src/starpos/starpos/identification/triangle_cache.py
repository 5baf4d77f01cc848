# SPDX-License-Identifier: Apache-2.0
"""Keep triangle catalogues: in memory, and in a cache on the disk from which they are memory-mapped."""

import hashlib
import os
import shutil
import tempfile
import threading
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import fields
from pathlib import Path

import numpy as np

from starpos.identification import triangles
from starpos.identification.quads import QuadCatalogue
from starpos.identification.triangles import TriangleCatalogue
from starpos.progress import Progress, quiet
from starpos.sky.catalogue import Catalogue
from starpos.sky.zones import CELLS, ZONES
from starpos.units import DAY_S

# Names of folders in the cache; the number is that of the format.
PREFIX = "triangles-9-"
SCRATCH = "unfinished-"
MOST_IN_USE = 4


def cache_folder() -> Path:
    """The folder where triangle catalogues are kept: $XDG_CACHE_HOME/starpos, by default ~/.cache/starpos."""
    given = os.environ.get("XDG_CACHE_HOME")
    try:
        return Path(given or Path.home() / ".cache") / "starpos"
    # a user without a home, as in some containers
    except RuntimeError:
        return Path(tempfile.gettempdir()) / f"starpos-{os.getuid()}"


def cached(catalogue: Catalogue, half_diagonal_rad: float, progress: Progress = quiet) -> TriangleCatalogue:
    """The TriangleCatalogue for a field of this half diagonal (rad), memory-mapped from the cache; built if missing.

    The field is rounded up to steps of 5 %, so that a refined focal length does not need a new one.
    """
    half_diagonal = float(1.05 ** np.ceil(np.log(half_diagonal_rad) / np.log(1.05)))
    with _lock:
        key = (catalogue.fingerprint, half_diagonal)
        if key not in _in_use:
            while len(_in_use) >= MOST_IN_USE:
                _in_use.pop(next(iter(_in_use)))
            _in_use[key] = _load_or_build(catalogue, half_diagonal, progress)
        return _in_use[key]


_lock = threading.Lock()
_in_use: dict[tuple, TriangleCatalogue] = {}


def _load_or_build(catalogue: Catalogue, half_diagonal: float, progress: Progress) -> TriangleCatalogue:
    settings = (
        catalogue.fingerprint,
        half_diagonal,
        triangles.CIRCLES,
        triangles.POOL_PER_CIRCLE,
        triangles.BEACONS,
        triangles.SHORTEST_SIDE,
        triangles.MAX_TRIANGLES,
    )
    digest = hashlib.sha256(repr(settings).encode()).hexdigest()[:16]
    folder = cache_folder() / f"{PREFIX}{np.degrees(2 * half_diagonal):.2f}deg-{digest}"
    if (stored := _map(folder, len(catalogue))) is not None:
        return stored
    with one_builder(folder.parent):
        # another process may have been first
        if (stored := _map(folder, len(catalogue))) is not None:
            return stored
        built = triangles.build(catalogue, half_diagonal, progress)
        try:
            store(built, folder)
        except OSError as e:
            warnings.warn(
                f"{folder.parent}: the triangle catalogue cannot be kept there ({e.strerror}), so that each start builds "
                "it again: make the folder writable or set XDG_CACHE_HOME",
                stacklevel=2,
            )
            return built
    return _map(folder, len(catalogue)) or built


@contextmanager
def one_builder(cache: Path) -> Iterator[None]:
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


def store(table: TriangleCatalogue | QuadCatalogue, folder: Path) -> None:
    """Write all columns into a new folder, then rename it, so that all of it is there or nothing."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    _clear(folder.parent)
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


def _clear(cache: Path) -> None:
    """Remove the folders of earlier formats, and unfinished ones that are older than a day."""
    for old in cache.glob("triangles-*"):
        if not old.name.startswith(PREFIX):
            shutil.rmtree(old, ignore_errors=True)
    for left in cache.glob(f"{SCRATCH}*"):
        with suppress(OSError):
            if time.time() - left.stat().st_mtime > DAY_S:
                shutil.rmtree(left, ignore_errors=True)


def _map(folder: Path, catalogue_stars: int) -> TriangleCatalogue | None:
    """The stored catalogue; None if it is missing or its columns do not fit together."""
    try:
        columns = {
            f.name: np.asarray(np.load(folder / f"{f.name}.npy", mmap_mode="r", allow_pickle=False))
            for f in fields(TriangleCatalogue)
        }
    except (OSError, ValueError, EOFError):
        return None
    t = TriangleCatalogue(**columns)
    stars, count = len(t.star), len(t.corners)
    # the kinds of numbers in the columns, in their order
    kinds = "iiiifibufi"
    fit = (
        [column.dtype.kind for column in columns.values()] == list(kinds)
        and t.bin_start.shape == (np.prod(triangles.BINS) + 1,)
        and t.cell_start.shape == (ZONES * CELLS + 1,)
        and t.corners.shape == t.shape.shape == (count, 3)
        and t.counter_clockwise.shape == (count,)
        and t.rank.shape == t.star.shape == (stars,)
        and t.beacons.shape == (len(t.beacon), 3)
        and t.longest_allowed.shape == (1,)
        and t.longest_allowed[0] > 0
        and _rising(t.bin_start, count)
        and _rising(t.cell_start, stars)
        and bool(np.all(np.diff(t.star) > 0))  # so that the first and the last are the limits
        and (stars == 0 or 0 <= t.star[0] <= t.star[-1] < catalogue_stars)
        and (count == 0 or 0 <= t.corners.min() <= t.corners.max() < stars)
        and bool(np.all(t.corners[:, 0] != t.corners[:, 1]))
    )
    return t if fit else None


def _rising(start: np.ndarray, end: int) -> bool:
    return bool(start[0] == 0 and start[-1] == end and np.all(np.diff(start) >= 0))

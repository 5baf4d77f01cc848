# SPDX-License-Identifier: Apache-2.0
"""Keep the quads of a star catalogue: in memory, and beside the triangles on the disk, memory-mapped."""

import hashlib
import threading
import warnings
from dataclasses import fields
from pathlib import Path

import numpy as np

from starpos.identification import quads
from starpos.identification.quads import QuadCatalogue
from starpos.identification.triangle_cache import cache_folder, one_builder, store
from starpos.progress import Progress, quiet
from starpos.sky.catalogue import Catalogue

# Name of the folder in the cache; the number is that of the format.
PREFIX = "quads-1-"

_lock = threading.Lock()
_in_use: dict[str, QuadCatalogue] = {}


def is_built(catalogue: Catalogue) -> bool:
    """Whether `cached` need not build."""
    return _digest(catalogue) in _in_use or _folder(catalogue).is_dir()


def cached(catalogue: Catalogue, progress: Progress = quiet) -> QuadCatalogue:
    """The QuadCatalogue of a star catalogue, memory-mapped from the cache (180 MB); built, in about 20 s, if missing."""
    digest = _digest(catalogue)
    with _lock:
        if digest not in _in_use:
            _in_use.clear()
            _in_use[digest] = _load_or_build(catalogue, _folder(catalogue), progress)
        return _in_use[digest]


def _digest(catalogue: Catalogue) -> str:
    settings = repr((catalogue.fingerprint, quads.LEVELS, quads.SPACING, quads.STARS_PER_CIRCLE, quads.LEAST_SIDE,
                     quads.SHORTEST, quads.BINS, quads.SIZE_BINS, quads.SIZES_RAD))  # fmt: skip
    return hashlib.sha256(settings.encode()).hexdigest()[:16]


def _folder(catalogue: Catalogue) -> Path:
    return cache_folder() / f"{PREFIX}{_digest(catalogue)}"


def _load_or_build(catalogue: Catalogue, folder: Path, progress: Progress) -> QuadCatalogue:
    if (stored := _map(folder, len(catalogue))) is not None:
        return stored
    with one_builder(folder.parent):
        # another process may have been first
        if (stored := _map(folder, len(catalogue))) is not None:
            return stored
        built = quads.build(catalogue, progress)
        try:
            store(built, folder)
        except OSError as e:
            warnings.warn(
                f"{folder.parent}: the star quads cannot be kept there ({e.strerror}), so that each start builds them "
                "again: make the folder writable or set XDG_CACHE_HOME",
                stacklevel=3,
            )
            return built
    return _map(folder, len(catalogue)) or built


def _map(folder: Path, catalogue_stars: int) -> QuadCatalogue | None:
    """The stored quads; None if they are missing or their columns do not fit together."""
    try:
        columns = {
            f.name: np.asarray(np.load(folder / f"{f.name}.npy", mmap_mode="r", allow_pickle=False))
            for f in fields(QuadCatalogue)
        }
    except (OSError, ValueError, EOFError):
        return None
    q = QuadCatalogue(**columns)
    count = len(q.corners)
    fit = (
        [column.dtype.kind for column in columns.values()] == list("iufi")
        and q.corners.shape == (count, 4)
        and q.shape.shape == (count, 5)
        and q.log_size.shape == (count,)
        and q.bin_start.shape == (quads.BINS**4 * quads.SIZE_BINS + 1,)
        and q.bin_start[0] == 0
        and q.bin_start[-1] == count
        and bool(np.all(np.diff(q.bin_start) >= 0))
        and (count == 0 or 0 <= q.corners.min() <= q.corners.max() < catalogue_stars)
    )
    return q if fit else None

# SPDX-License-Identifier: Apache-2.0
"""Keep the quads of a star catalogue: in memory, and next to the triangles on the disk, memory-mapped."""

import hashlib
import threading
from pathlib import Path

from starpos.identification import quads
from starpos.identification.quads import QuadCatalogue
from starpos.progress import Progress, quiet
from starpos.sky.catalogue import Catalogue
from starpos.table_cache import cache_folder, load_or_build, mapped, rising

# Cache folder; the number is the format version.
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
            folder = _folder(catalogue)
            _in_use[digest] = load_or_build(
                folder,
                PREFIX,
                lambda: _map(folder, len(catalogue)),
                lambda: quads.build(catalogue, progress),
                "star quads",
            )
        return _in_use[digest]


def _digest(catalogue: Catalogue) -> str:
    settings = repr((catalogue.fingerprint, quads.LEVELS, quads.SPACING, quads.STARS_PER_CIRCLE, quads.MIN_SIDE,
                     quads.SHORTEST, quads.BINS, quads.SIZE_BINS, quads.SIZES_RAD))  # fmt: skip
    return hashlib.sha256(settings.encode()).hexdigest()[:16]


def _folder(catalogue: Catalogue) -> Path:
    return cache_folder() / f"{PREFIX}{_digest(catalogue)}"


def _map(folder: Path, catalogue_stars: int) -> QuadCatalogue | None:
    """The stored quads; None if they are missing or their columns do not fit together."""
    q = mapped(QuadCatalogue, folder, "iufi")
    if q is None:
        return None
    count = len(q.corners)
    fit = (
        q.corners.shape == (count, 4)
        and q.shape.shape == (count, 5)
        and q.log_size.shape == (count,)
        and q.bin_start.shape == (quads.BINS**4 * quads.SIZE_BINS + 1,)
        and rising(q.bin_start, count)
        and (count == 0 or 0 <= q.corners.min() <= q.corners.max() < catalogue_stars)
    )
    return q if fit else None

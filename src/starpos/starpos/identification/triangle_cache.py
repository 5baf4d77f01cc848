# SPDX-License-Identifier: Apache-2.0
"""Keep triangle catalogues: in memory, and in a cache on the disk from which they are memory-mapped."""

import hashlib
import math
import threading
from pathlib import Path

import numpy as np

from starpos.identification import triangles
from starpos.identification.triangles import TriangleCatalogue
from starpos.progress import Progress, quiet
from starpos.sky.catalogue import Catalogue
from starpos.sky.zones import CELLS, ZONES
from starpos.table_cache import cache_folder, load_or_build, mapped, rising

# Names of folders in the cache; the number is that of the format.
PREFIX = "triangles-10-"
MOST_IN_USE = 4


def cached(catalogue: Catalogue, half_diagonal_rad: float, progress: Progress = quiet) -> TriangleCatalogue:
    """The TriangleCatalogue for a field of this half diagonal (rad), memory-mapped from the cache; built if missing.

    The field is rounded up to steps of 5 %, so that a refined focal length does not need a new one.
    """
    half_diagonal = 1.05 ** math.ceil(math.log(half_diagonal_rad) / math.log(1.05))
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
        triangles.affordable(half_diagonal),
        triangles.POOL_PER_CIRCLE,
        triangles.BEACONS,
        triangles.SHORTEST_SIDE,
    )
    digest = hashlib.sha256(repr(settings).encode()).hexdigest()[:16]
    folder = cache_folder() / f"{PREFIX}{np.degrees(2 * half_diagonal):.2f}deg-{digest}"
    return load_or_build(
        folder,
        PREFIX,
        lambda: _map(folder, len(catalogue)),
        lambda: triangles.build(catalogue, half_diagonal, progress),
        "triangles",
    )


def _map(folder: Path, catalogue_stars: int) -> TriangleCatalogue | None:
    """The stored catalogue; None if it is missing or its columns do not fit together."""
    t = mapped(TriangleCatalogue, folder, "iiiifibufi")
    if t is None:
        return None
    stars, count = len(t.star), len(t.corners)
    fit = (
        t.bin_start.shape == (np.prod(triangles.BINS) + 1,)
        and t.cell_start.shape == (ZONES * CELLS + 1,)
        and t.corners.shape == t.shape.shape == (count, 3)
        and t.counter_clockwise.shape == (count,)
        and t.rank.shape == t.star.shape == (stars,)
        and t.beacons.shape == (len(t.beacon), 3)
        and t.longest_allowed.shape == (1,)
        and t.longest_allowed[0] > 0
        and rising(t.bin_start, count)
        and rising(t.cell_start, stars)
        # So that the first and the last are the limits.
        and bool(np.all(np.diff(t.star) > 0))
        and (stars == 0 or 0 <= t.star[0] <= t.star[-1] < catalogue_stars)
        and (count == 0 or 0 <= t.corners.min() <= t.corners.max() < stars)
        and bool(np.all(t.corners[:, 0] != t.corners[:, 1]))
    )
    return t if fit else None

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
from starpos.table_cache import cache_folder, load_or_build, mapped

# Cache folders; the number is the format version. Up to 10, tables of over 2 million stars may be wrong.
PREFIX = "triangles-11-"
MAX_IN_USE = 4


def cached(catalogue: Catalogue, half_diagonal_rad: float, progress: Progress = quiet) -> TriangleCatalogue:
    """The TriangleCatalogue for a field of this half diagonal (rad), memory-mapped from the cache; built if missing.

    The field is rounded up to steps of 5 %, so that a refined focal length does not need a new one.
    """
    half_diagonal = _rounded(half_diagonal_rad)
    with _lock:
        key = (catalogue.fingerprint, half_diagonal)
        if key not in _in_use:
            while len(_in_use) >= MAX_IN_USE:
                _in_use.pop(next(iter(_in_use)))
            _in_use[key] = _load_or_build(catalogue, half_diagonal, progress)
        return _in_use[key]


def _rounded(half_diagonal_rad: float) -> float:
    return 1.05 ** math.ceil(math.log(half_diagonal_rad) / math.log(1.05))


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
    try:
        t.check(catalogue_stars)
    except ValueError:
        return None
    return t

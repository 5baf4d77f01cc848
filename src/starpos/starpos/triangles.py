# SPDX-License-Identifier: Apache-2.0
"""Spherical triangles: their angles (the paper's equations 3 and 4), and the catalogue of them that is searched.

The angles hardly depend on the focal length, which is why the paper keys by them.  Stars are chosen by local density:
a star belongs if it is among the brightest of its neighbourhood, so every field of the instrument holds enough.
"""

import hashlib
import os
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, fields
from functools import lru_cache
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from starpos.catalogue import Catalogue
from starpos.errors import CatalogueError

FORMAT = 2
BRIGHTER_NEIGHBOURS = 16  # a star is kept if fewer than this many outshine it within half a field
MAX_TRIANGLES = 4_000_000
SHORTEST_SIDE = 0.03  # of the longest allowed: shorter sides make angles that a centroid's error blurs
LARGEST_BINS, SMALLEST_BINS = 2048, 1024  # of the largest angle, 60..180 deg, and of the smallest, 0..60 deg


def sides(v1: np.ndarray, v2: np.ndarray) -> np.ndarray:
    """Angular separation in rad of unit vectors (..., 3): equation 3, in the form that keeps small angles exact."""
    return 2 * np.arcsin(np.minimum(1.0, 0.5 * np.linalg.norm(v1 - v2, axis=-1)))


def angles(v1: np.ndarray, v2: np.ndarray, v3: np.ndarray) -> np.ndarray:
    """The three angles (..., 3) in rad at v1, v2, v3 of spherical triangles.

    Equation 4 by the half-angle formula, tan(A/2)^2 = sin(s-b) sin(s-c) / (sin s sin(s-a)): exact for small triangles.
    """
    a, b, c = sides(v2, v3), sides(v1, v3), sides(v1, v2)
    s = (a + b + c) / 2
    sa, sb, sc = (np.sin(np.maximum(s - x, 0.0)) for x in (a, b, c))
    ss = np.sin(s)
    return np.stack(
        [
            2 * np.arctan2(np.sqrt(sb * sc), np.sqrt(ss * sa)),
            2 * np.arctan2(np.sqrt(sa * sc), np.sqrt(ss * sb)),
            2 * np.arctan2(np.sqrt(sa * sb), np.sqrt(ss * sc)),
        ],
        -1,
    )


@dataclass(frozen=True)
class TriangleCatalogue:
    """Triangles of chosen stars in bins of (largest angle, smallest angle).

    star (S,): index into the star catalogue; directions (S, 3): ICRS at J2000; corners (T, 3): rows of `star`, the
    corner of the largest angle first, of the smallest last; largest, smallest (T,) rad; bin_start (bins + 1,);
    longest_side (1,) rad.
    """

    star: np.ndarray
    directions: np.ndarray
    corners: np.ndarray
    largest: np.ndarray
    smallest: np.ndarray
    bin_start: np.ndarray
    longest_side: np.ndarray

    def near(self, largest, smallest, tol_largest, tol_smallest) -> tuple[np.ndarray, np.ndarray]:
        """Triangles within tolerances of Q pairs of angles (Q,): (query (M,), triangle (M,)), any order.

        The work goes with the answers, not with the catalogue: each query reads the bins its rectangle touches.
        """
        row0, row1 = (_bin_largest(largest + k * tol_largest) for k in (-1, 1))
        col0, col1 = (_bin_smallest(smallest + k * tol_smallest) for k in (-1, 1))
        rows = row1 - row0 + 1
        query = np.repeat(np.arange(len(rows)), rows)
        row = row0[query] + np.arange(len(query)) - np.repeat(np.cumsum(rows) - rows, rows)
        first = self.bin_start[row * SMALLEST_BINS + col0[query]]
        count = self.bin_start[row * SMALLEST_BINS + col1[query] + 1] - first
        query = np.repeat(query, count)
        triangle = np.arange(len(query)) + np.repeat(first - (np.cumsum(count) - count), count)
        close = np.abs(self.largest[triangle] - largest[query]) <= tol_largest[query]
        close &= np.abs(self.smallest[triangle] - smallest[query]) <= tol_smallest[query]
        return query[close], triangle[close]


def _bin_largest(angle):
    return np.clip(
        ((angle - np.pi / 3) * (LARGEST_BINS / (2 * np.pi / 3))).astype(np.int64), 0, LARGEST_BINS - 1
    )


def _bin_smallest(angle):
    return np.clip((angle * (SMALLEST_BINS / (np.pi / 3))).astype(np.int64), 0, SMALLEST_BINS - 1)


Progress = Callable[[str, float], None]


def build(
    catalogue: Catalogue, longest_side: float, progress: Progress = lambda what, done: None
) -> TriangleCatalogue:
    """Triangles with every side below `longest_side` rad, the diagonal of the field.

    Each star makes triangles with the pairs of its brighter neighbours within half of that, so that each triangle is
    made once, by its faintest star.
    """
    reach = longest_side / 2
    by_light = np.argsort(catalogue.vmag_centi, kind="stable")
    brighter = BRIGHTER_NEIGHBOURS
    # the density that makes at most MAX_TRIANGLES: brighter/(pi reach^2) stars, each with about brighter^2/6 pairs
    cells = 4 / reach**2
    while brighter > 8 and cells * brighter * (brighter - 1) * (brighter - 2) / 6 > MAX_TRIANGLES:
        brighter -= 1
    enough = min(len(by_light), int(6 * cells * brighter) + 1000)
    candidates = by_light[:enough]
    v = catalogue.directions(candidates)
    tree = cKDTree(v)
    corners = []
    block = max(1000, enough // 40)
    for start in range(0, enough, block):
        own = np.arange(start, min(start + block, enough))
        corners.append(_with_brighter_pairs(tree, own, 2 * np.sin(reach / 2), brighter))
        progress("triangles", (start + len(own)) / enough)
    return _assemble(candidates, v, np.concatenate(corners), longest_side)


def _with_brighter_pairs(tree: cKDTree, own: np.ndarray, chord: float, brighter: int) -> np.ndarray:
    """Triangles (M, 3) of each star of `own` with the pairs of its brighter neighbours, if these are not too many.

    The tree's rows are in order of brightness, so a smaller row is a brighter star.
    """
    by_rank: dict[int, list] = {}
    for star, near in zip(
        own.tolist(), tree.query_ball_point(tree.data[own], chord, return_sorted=True), strict=True
    ):
        rank = int(np.searchsorted(near, star))
        if 2 <= rank < brighter:
            by_rank.setdefault(rank, []).append([star, *near[:rank]])
    triangles = [np.zeros((0, 3), np.int64)]
    for rank, rows in by_rank.items():
        i, j = np.triu_indices(rank, 1)
        rows = np.array(rows)
        faintest = np.repeat(rows[:, 0], len(i))
        triangles.append(np.stack([faintest, rows[:, 1 + i].ravel(), rows[:, 1 + j].ravel()], -1))
    return np.concatenate(triangles)


def _assemble(candidates, v, corner, longest_side) -> TriangleCatalogue:
    p = [v[corner[:, k]] for k in range(3)]
    length = np.stack([sides(p[1], p[2]), sides(p[0], p[2]), sides(p[0], p[1])], -1)
    good = (length.max(1) < longest_side) & (length.min(1) > SHORTEST_SIDE * longest_side)
    corner = corner[good]
    angle = angles(*(q[good] for q in p))
    order = np.argsort(-angle, axis=1, kind="stable")
    corner = np.take_along_axis(corner, order, 1)
    largest, smallest = angle.max(1), angle.min(1)
    key = _bin_largest(largest) * SMALLEST_BINS + _bin_smallest(smallest)
    sort = np.argsort(key, kind="stable")
    used = np.unique(corner)
    return TriangleCatalogue(
        candidates[used].astype(np.int32),
        v[used],
        np.searchsorted(used, corner[sort]).astype(np.int32),
        largest[sort].astype(np.float32),
        smallest[sort].astype(np.float32),
        np.searchsorted(key[sort], np.arange(LARGEST_BINS * SMALLEST_BINS + 1)).astype(np.int32),
        np.array([longest_side]),
    )


def cache_folder() -> Path:
    """Where built triangle catalogues are kept: $XDG_CACHE_HOME/starpos, by default ~/.cache/starpos."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "starpos"


def cached(catalogue: Catalogue, half_diagonal_rad: float, progress: Progress = lambda what, done: None):
    """The TriangleCatalogue for a field of this half diagonal: memory-mapped from the cache, built when it is not there.

    The field is rounded up to steps of 5 %, so that a refined focal length does not build a new one.
    """
    step = np.ceil(np.log(2 * half_diagonal_rad) / np.log(1.05))
    return _cached(catalogue, float(1.05**step), progress)


@lru_cache(maxsize=4)
def _cached(catalogue: Catalogue, longest_side: float, progress: Progress) -> TriangleCatalogue:
    limits = (BRIGHTER_NEIGHBOURS, MAX_TRIANGLES, SHORTEST_SIDE)
    settings = f"{FORMAT} {catalogue.fingerprint} {longest_side:.6f} {limits}"
    digest = hashlib.sha256(settings.encode()).hexdigest()[:16]
    folder = cache_folder() / f"triangles-{np.degrees(longest_side):.2f}deg-{digest}"
    if not folder.is_dir():
        _store(build(catalogue, longest_side, progress), folder)
    return _map(folder)


def _store(triangles: TriangleCatalogue, folder: Path) -> None:
    """Write all columns into a new folder, then name it: another process sees all of it or nothing."""
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder.parent) as scratch:
            whole = Path(scratch) / "whole"
            whole.mkdir()
            for f in fields(triangles):
                np.save(whole / f"{f.name}.npy", getattr(triangles, f.name))
            try:
                whole.rename(folder)
            except OSError:
                if not folder.is_dir():  # otherwise another process was first
                    raise
    except OSError as e:
        raise CatalogueError(f"{folder.parent}: cannot keep the triangle catalogue there ({e}); free the disk or set "
                             "XDG_CACHE_HOME") from None  # fmt: skip


def _map(folder: Path) -> TriangleCatalogue:
    try:
        columns = {
            f.name: np.load(folder / f"{f.name}.npy", mmap_mode="r", allow_pickle=False)
            for f in fields(TriangleCatalogue)
        }
        if len(columns["bin_start"]) != LARGEST_BINS * SMALLEST_BINS + 1:
            raise ValueError("bins do not fit")
        return TriangleCatalogue(**{k: np.asarray(v) for k, v in columns.items()})
    except (OSError, ValueError, EOFError) as e:
        raise CatalogueError(
            f"{folder}: a broken triangle catalogue ({e}): remove the folder, it is built anew"
        ) from None

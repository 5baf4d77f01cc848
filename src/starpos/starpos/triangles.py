# SPDX-License-Identifier: Apache-2.0
"""Spherical triangles: their angles (the paper's equations 3 and 4), and the catalogue of them that is searched.

The angles hardly depend on the focal length, which is why the paper keys by them.  Stars are chosen by local density:
every circle of the field's size gives its own brightest stars, so that every field of the instrument holds enough.
"""

import hashlib
import os
import tempfile
import threading
import warnings
from dataclasses import dataclass, fields
from itertools import combinations
from math import comb
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from starpos.catalogue import EPOCH, Catalogue
from starpos.progress import Progress, quiet
from starpos.zones import CELLS, ZONES, cell_starts, ranges, rows_near

FORMAT = 6
SHORTEST_SIDE = 0.03  # of the longest allowed: shorter sides make angles that a centroid's error blurs
# of the largest angle, 60..180 deg; of the smallest, 0..60 deg; of the longest side, 0..the longest allowed
BINS = LARGEST_BINS, SMALLEST_BINS, LONGEST_BINS = 256, 128, 64
POOL_PER_CIRCLE = 25  # stars brighter than the pool's limit in an average circle of the smaller kind
# Circles laid over the whole sky: (radius over the field's half diagonal, spacing over radius, brightest stars taken).
# The first fits into a field of 3:2 or 4:3, the second is the whole field's own.
CIRCLES = ((0.6, 0.7, 7), (1.0, 0.7, 9))
MOST_IN_USE = 4
BLOCK = 100_000
MAX_TRIANGLES = 6_000_000  # before those that several circles share are counted once


def sides(v1: np.ndarray, v2: np.ndarray) -> np.ndarray:
    """Angular separation in rad of unit vectors (..., 3): equation 3, in the form that keeps small angles exact."""
    apart = v1 - v2
    return 2 * np.arcsin(np.minimum(1.0, 0.5 * np.sqrt(np.einsum("...i,...i->...", apart, apart))))


def opposite_sides(v: np.ndarray) -> np.ndarray:
    """The sides (..., 3) in rad opposite the corners v (..., 3, 3) of spherical triangles."""
    return sides(v[..., [1, 0, 0], :], v[..., [2, 2, 1], :])


def angles(side: np.ndarray) -> np.ndarray:
    """The angles (..., 3) in rad of spherical triangles with sides (..., 3), each opposite its angle.

    Equation 4 by the half-angle formula, tan(A/2)^2 = sin(s-b) sin(s-c) / (sin s sin(s-a)): exact for small triangles.
    """
    s = side.sum(-1, keepdims=True) / 2
    rest = np.sin(np.maximum(s - side, 0.0))
    return 2 * np.arctan2(np.sqrt(rest[..., [1, 0, 0]] * rest[..., [2, 2, 1]]), np.sqrt(np.sin(s) * rest))


@dataclass(frozen=True)
class TriangleCatalogue:
    """Triangles of the sky's brightest stars in bins of (largest angle, smallest angle, longest side).

    The stars, in zones as the catalogue's: star (S,) index into the star catalogue; cell_start as `zones` has it;
    rank (S,) in brightness over the sky; directions (S, 3) ICRS at J2000; motion (S, 3) rad a year.
    The triangles: corners (T, 3) rows of `star`, the corner of the largest angle first, of the smallest last; largest,
    smallest angle and longest side (T,) rad; longest_allowed (1,) rad; bin_start (bins + 1,).
    """

    star: np.ndarray
    cell_start: np.ndarray
    rank: np.ndarray
    directions: np.ndarray
    motion: np.ndarray
    corners: np.ndarray
    largest: np.ndarray
    smallest: np.ndarray
    longest: np.ndarray
    longest_allowed: np.ndarray
    bin_start: np.ndarray

    def places(self, row: np.ndarray, year: float) -> np.ndarray:
        """ICRS directions (n, 3) of rows of `star` at a Julian year."""
        v = self.directions[row] + self.motion[row] * (year - EPOCH)
        return v / np.sqrt(np.einsum("ni,ni->n", v, v))[:, None]

    def stars_near(self, centre: np.ndarray, radius_rad: float) -> tuple[np.ndarray, np.ndarray]:
        """Rows of `star` in and about the cones around centre (Q, 3): (cone (M,), row (M,))."""
        return rows_near(self.cell_start, centre, radius_rad)

    def near(self, shape: np.ndarray, tolerance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Triangles within tolerance (Q, 3) of shape (Q, 3), the largest angle, the smallest, the longest side.

        Returns (query (M,), triangle (M,)) in any order.  The work goes with the answers, not with the catalogue: each
        query reads the bins that its box touches.
        """
        low, high = self._bins(np.concatenate([shape - tolerance, shape + tolerance])).reshape(2, -1, 3)
        query, first = ranges(low[:, 0], high[:, 0] - low[:, 0] + 1)
        row, second = ranges(low[query, 1], (high - low)[query, 1] + 1)
        query, run = query[row], (first[row] * SMALLEST_BINS + second) * LONGEST_BINS
        begin, end = self.bin_start[run + low[query, 2]], self.bin_start[run + high[query, 2] + 1]
        row, triangle = ranges(begin, end - begin)
        query = query[row]
        close = np.abs(self.largest[triangle] - shape[query, 0]) <= tolerance[query, 0]
        close &= np.abs(self.smallest[triangle] - shape[query, 1]) <= tolerance[query, 1]
        close &= np.abs(self.longest[triangle] - shape[query, 2]) <= tolerance[query, 2]
        return query[close], triangle[close]

    def _bins(self, shape: np.ndarray) -> np.ndarray:
        return _bins(*shape.T, self.longest_allowed[0])


def _bins(largest, smallest, longest, longest_allowed) -> np.ndarray:
    """The bin (n, 3) of triangles; what is outside belongs to the bin at the edge."""
    part = np.stack([largest, smallest, longest], -1).astype(float)
    part -= [np.pi / 3, 0, 0]
    part /= [2 * np.pi / 3, np.pi / 3, longest_allowed]
    return np.minimum(np.maximum(part * BINS, 0).astype(np.int64), np.array(BINS) - 1)


def build(catalogue: Catalogue, half_diagonal: float, progress: Progress = quiet) -> TriangleCatalogue:
    """Triangles for a field of this half diagonal (rad): those of the brightest stars of every circle over the sky.

    A circle takes its own brightest stars, however bright its neighbours are, so that every part of the sky has enough.
    """
    by_light = np.argsort(catalogue.vmag_centi, kind="stable")
    smallest_circle = min(radius for radius, _, _ in CIRCLES) * half_diagonal
    circles = 4 / smallest_circle**2  # that make up a sphere
    pool = np.sort(by_light[: int(POOL_PER_CIRCLE * circles) + 1000])
    rank = np.argsort(np.argsort(catalogue.vmag_centi[pool], kind="stable"))
    v = catalogue.directions(pool)
    motion = catalogue.directions(pool, EPOCH + 1) - v
    brightest_first = np.argsort(rank)
    tree = cKDTree(v[brightest_first])
    fewer = 0  # stars taken from each circle, so that a small field does not make too many triangles
    while (
        sum(_circles(r * half_diagonal, s) * comb(n - fewer, 3) for r, s, n in CIRCLES) > MAX_TRIANGLES
        and fewer < 3
    ):
        fewer += 1
    keys = []
    for k, (radius, spacing, most) in enumerate(CIRCLES):
        keys.append(_triples_of_circles(tree, radius * half_diagonal, spacing, most - fewer))
        progress("star triangles", (k + 1) / (len(CIRCLES) + 1))
    key = np.unique(np.concatenate(keys))
    del keys
    corner, largest, smallest, longest, bin_start = _in_bins(v, brightest_first, key, 2 * half_diagonal)
    progress("star triangles", 1.0)
    return TriangleCatalogue(
        pool.astype(np.int32),
        cell_starts(np.searchsorted(pool, catalogue.zone_start), catalogue.ra_mas[pool] / 3.6e6),
        rank.astype(np.int32),
        v,
        motion.astype(np.float32),
        corner,
        largest,
        smallest,
        longest,
        np.array([2 * half_diagonal]),
        bin_start.astype(np.int32),
    )


def _triples_of_circles(tree: cKDTree, radius: float, spacing: float, most: int) -> np.ndarray:
    """Keys of all triples among the `most` first rows of the tree in each circle; a key is (a n + b) n + c, a < b < c."""
    centres = _spread(_circles(radius, spacing))
    n, chord = tree.n, 2 * np.sin(radius / 2)
    found = []
    for block in np.array_split(centres, max(1, len(centres) // 1000)):
        lists = [near[:most] for near in tree.query_ball_point(block, chord, return_sorted=True)]
        size = np.array([len(near) for near in lists])
        for m in range(3, most + 1):
            rows = np.array([near for near, k in zip(lists, size == m, strict=True) if k], np.int64).reshape(
                -1, m
            )
            i, j, k = np.array(list(combinations(range(m), 3))).T
            found.append(np.unique((rows[:, i] * n + rows[:, j]) * n + rows[:, k]))
    return np.unique(np.concatenate(found))


def _circles(radius: float, spacing: float) -> int:
    """How many circles of this radius (rad) lie spacing * radius apart on a sphere."""
    return int(4 * np.pi / (spacing * radius) ** 2) + 50


def _spread(n: int) -> np.ndarray:
    """n nearly even unit vectors (n, 3) over the sphere, from south to north: a golden spiral."""
    k = np.arange(n)
    z = (2 * k + 1) / n - 1
    angle = k * (np.pi * (3 - np.sqrt(5)))
    level = np.sqrt(1 - z * z)
    return np.stack([level * np.cos(angle), level * np.sin(angle), z], -1)


def _in_bins(v: np.ndarray, brightest_first: np.ndarray, triples: np.ndarray, longest_side: float):
    """Usable triangles in order of their bins: corners (largest angle first), angles, longest side, bin starts."""
    n, parts = len(brightest_first), []
    # a whole sky of triangles at once is 500 MB
    for key in np.array_split(triples, len(triples) // BLOCK + 1):
        corner = brightest_first[np.stack([key // (n * n), key // n % n, key % n], -1)]
        parts.append(_measured(v, corner, longest_side))
    corner, largest, smallest, longest, bins = (np.concatenate(c) for c in zip(*parts, strict=True))
    del parts
    order = np.argsort(bins, kind="stable")
    starts = np.concatenate([[0], np.cumsum(np.bincount(bins, minlength=np.prod(BINS)))])
    return corner[order], largest[order], smallest[order], longest[order], starts


def _measured(v: np.ndarray, corner: np.ndarray, longest_side: float):
    """Those triangles (M, 3) whose sides serve, the corner of the largest angle first; angles, longest side and bin."""
    length = opposite_sides(v[corner])
    good = (length.max(1) < longest_side) & (length.min(1) > SHORTEST_SIDE * longest_side)
    corner, length = corner[good], length[good]
    angle = angles(length)
    corner = np.take_along_axis(corner, np.argsort(-angle, axis=1, kind="stable"), 1)
    shape = [x.astype(np.float32) for x in (angle.max(1), angle.min(1), length.max(1))]
    bins = np.ravel_multi_index(_bins(*shape, longest_side).T, BINS)
    return corner.astype(np.int32), *shape, bins.astype(np.int32)


def cache_folder() -> Path:
    """Where built triangle catalogues are kept: $XDG_CACHE_HOME/starpos, by default ~/.cache/starpos."""
    given = os.environ.get("XDG_CACHE_HOME")
    try:
        return Path(given or Path.home() / ".cache") / "starpos"
    except RuntimeError:  # a user without a home, as in some containers
        return Path(tempfile.gettempdir()) / f"starpos-{os.getuid()}"


def cached(catalogue: Catalogue, half_diagonal_rad: float, progress: Progress = quiet) -> TriangleCatalogue:
    """The TriangleCatalogue for a field of this half diagonal: memory-mapped from the cache, built when it is not there.

    The field is rounded up to steps of 5 %, so that a refined focal length does not build a new one.
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
        f"{FORMAT} {catalogue.fingerprint} {half_diagonal:.6f} {CIRCLES} {POOL_PER_CIRCLE} {SHORTEST_SIDE}"
    )
    digest = hashlib.sha256(settings.encode()).hexdigest()[:16]
    folder = cache_folder() / f"triangles-{np.degrees(2 * half_diagonal):.2f}deg-{digest}"
    if (stored := _map(folder)) is not None:
        return stored
    built = build(catalogue, half_diagonal, progress)
    try:
        _store(built, folder)
    except OSError as e:
        warnings.warn(
            f"{folder.parent}: the triangle catalogue cannot be kept there ({e.strerror}), so that each start builds it "
            "again: make the folder writable or set XDG_CACHE_HOME",
            stacklevel=2,
        )
        return built
    return _map(folder) or built


def _store(triangles: TriangleCatalogue, folder: Path) -> None:
    """Write all columns into a new folder, then name it: another process sees all of it or nothing."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=folder.parent) as scratch:
        whole = Path(scratch) / "whole"
        whole.mkdir()
        for f in fields(triangles):
            np.save(whole / f"{f.name}.npy", getattr(triangles, f.name))
        if folder.exists():  # it was broken, or it would have been used
            folder.rename(Path(scratch) / "broken")
        try:
            whole.rename(folder)
        except OSError:
            if not folder.is_dir():  # otherwise another process was first
                raise


def _map(folder: Path) -> TriangleCatalogue | None:
    """The stored catalogue; None where there is none or its parts do not fit together."""
    try:
        columns = {
            f.name: np.asarray(np.load(folder / f"{f.name}.npy", mmap_mode="r", allow_pickle=False))
            for f in fields(TriangleCatalogue)
        }
    except (OSError, ValueError, EOFError):
        return None
    t = TriangleCatalogue(**columns)
    stars, count = len(t.star), len(t.corners)
    fit = (
        t.bin_start.shape == (np.prod(BINS) + 1,)
        and t.bin_start[-1] == count
        and t.corners.shape == (count, 3)
        and len(t.largest) == len(t.smallest) == len(t.longest) == count
        and t.directions.shape == t.motion.shape == (stars, 3)
        and t.cell_start.shape == (ZONES * CELLS + 1,)
        and len(t.rank) == t.cell_start[-1] == stars
        and t.longest_allowed.shape == (1,)
        and (count == 0 or 0 <= t.corners.min() <= t.corners.max() < stars)
    )
    return t if fit else None

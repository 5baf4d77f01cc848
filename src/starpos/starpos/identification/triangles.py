# SPDX-License-Identifier: Apache-2.0
"""Spherical triangles, their angles (the paper's section 2.1.1), and the catalogue of triangles that is searched.

Triangles are found by their angles, as in the paper, because these hardly depend on the focal length. Every circle of the
field's size gives its own brightest stars, so that every field of the instrument has enough triangles.
"""

from dataclasses import dataclass
from itertools import combinations
from math import comb
from typing import TYPE_CHECKING

import numpy as np

from starpos.progress import Progress, quiet
from starpos.sky.catalogue import Catalogue
from starpos.sky.zones import CELLS, ZONES, cell_starts, ranges

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

# Shortest side over the longest allowed one: the errors of centroids blur the angles of smaller triangles.
SHORTEST_SIDE = 0.03
# Shapes (largest angle 60..180 deg, smallest 0..60 deg, longest side 0..the longest allowed) are kept to 1/65536 of
# these ranges; the highest bits of the three are a triangle's bin.
CODES = 1 << 16
# Density of shapes where they are looked up, over the mean density.
CROWDED = 5.0
BIN_BITS = (8, 7, 6)
BINS = tuple(1 << bits for bits in BIN_BITS)
# Stars of the pool in an average circle of the smallest kind.
POOL_PER_CIRCLE = 25
# This share of the pool, the brightest over the whole sky, are beacons.
BEACONS = 0.25
# Circles over the whole sky: (radius over the field's half diagonal, spacing over radius, brightest stars taken). The
# first fits into a field of 3:2 or 4:3, the last contains the whole field.
CIRCLES = ((0.6, 0.7, 7), (0.8, 0.7, 8), (1.0, 0.7, 9))
BLOCK = 100_000
# Limit, counted before duplicates of overlapping circles are removed.
MAX_TRIANGLES = 6_000_000


def sides(v1: np.ndarray, v2: np.ndarray) -> np.ndarray:
    """Angular separation in rad of unit vectors (..., 3): in the form that keeps small ones exact."""
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


@dataclass(frozen=True, kw_only=True)
class TriangleCatalogue:
    """T triangles of the sky's S brightest stars, in bins of their shape.

    star               (S,): rows of the star catalogue, in its order
    cell_start         first row of each cell, as `zones.cell_starts` returns it
    rank               (S,): rank in brightness over the sky
    beacon, beacons    (B,) rows of the brightest of these stars, (B, 3) their directions at J2000
    corners            (T, 3): rows of `star`, the corner of the largest angle first, of the smallest last
    counter_clockwise  (T,): orientation seen from within the sphere
    shape              (T, 3): in CODES
    longest_allowed    (1,): longest side, rad
    bin_start          (bins + 1,): first triangle of each bin
    """

    star: np.ndarray
    cell_start: np.ndarray
    rank: np.ndarray
    beacon: np.ndarray
    beacons: np.ndarray
    corners: np.ndarray
    counter_clockwise: np.ndarray
    shape: np.ndarray
    longest_allowed: np.ndarray
    bin_start: np.ndarray

    def near(self, shape: np.ndarray, tolerance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Triangles within tolerance (Q, 3) of shape (Q, 3): largest angle, smallest angle and longest side, rad.

        Returns arrays of query (M,) and triangle (M,), in any order. Only the bins that a query touches are read, so the
        time grows with the number of answers, not with the catalogue.
        """
        box = np.concatenate([shape - tolerance, shape + tolerance])
        low, high = _coded(box, self.longest_allowed[0]).reshape(2, -1, 3)
        first, last = _bins(low), _bins(high)
        query, row = ranges(first[:, 0], last[:, 0] - first[:, 0] + 1)
        of, column = ranges(first[query, 1], (last - first)[query, 1] + 1)
        query, run = query[of], (row[of] * BINS[1] + column) * BINS[2]
        begin, end = self.bin_start[run + first[query, 2]], self.bin_start[run + last[query, 2] + 1]
        of, triangle = ranges(begin, end - begin)
        query = query[of]
        code = self.shape[triangle]
        close = (code >= low[query]) & (code <= high[query])
        # faster than all(1)
        close = close[:, 0] & close[:, 1] & close[:, 2]
        return query[close], triangle[close]

    def expected(self, tolerance: np.ndarray) -> np.ndarray:
        """Approximate number of triangles (Q,) within tolerance (Q, 3) of a shape."""
        ranges_rad = np.array([2 * np.pi / 3, np.pi / 3, self.longest_allowed[0]])
        return CROWDED * len(self.corners) * np.prod(np.minimum(2 * tolerance / ranges_rad, 1.0), axis=1)

    def longest(self, triangle: np.ndarray) -> np.ndarray:
        """Longest sides (M,) of triangles, rad."""
        return (self.shape[triangle, 2] + 0.5) * (self.longest_allowed[0] / CODES)


def no_triangles() -> TriangleCatalogue:
    """A TriangleCatalogue without any, for a sky whose field is not known beforehand."""
    none, bins = np.zeros(0, np.int32), int(np.prod(BINS))
    return TriangleCatalogue(
        star=none,
        cell_start=np.zeros(ZONES * CELLS + 1, np.int32),
        rank=none,
        beacon=none,
        beacons=np.zeros((0, 3)),
        corners=np.zeros((0, 3), np.int32),
        counter_clockwise=np.zeros(0, bool),
        shape=np.zeros((0, 3), np.uint16),
        longest_allowed=np.ones(1),
        bin_start=np.zeros(bins + 1, np.int8),
    )


def _coded(shape: np.ndarray, longest_allowed: float) -> np.ndarray:
    """Shapes (n, 3) in CODES, limited to the ranges."""
    part = shape - [np.pi / 3, 0.0, 0.0]
    part *= CODES / np.array([2 * np.pi / 3, np.pi / 3, longest_allowed])
    return np.minimum(np.maximum(part, 0).astype(np.int32), CODES - 1)


def _bins(code: np.ndarray) -> np.ndarray:
    """Bins (n, 3) of shapes (n, 3) in CODES."""
    return code >> (16 - np.array(BIN_BITS))


def counter_clockwise(v: np.ndarray) -> np.ndarray:
    """Whether triangles (M, 3, 3) are counter-clockwise, seen from within the sphere."""
    (ax, ay, az), (bx, by, bz), (cx, cy, cz) = np.moveaxis(v, 0, -1)
    return ax * (by * cz - bz * cy) + ay * (bz * cx - bx * cz) + az * (bx * cy - by * cx) < 0


def build(catalogue: Catalogue, half_diagonal: float, progress: Progress = quiet) -> TriangleCatalogue:
    """Triangles for a field of this half diagonal (rad): those of the brightest stars of every circle over the sky.

    A circle takes its own brightest stars, however bright its neighbours are, so that every part of the sky has enough.
    """
    # slow to import, and mostly the cache has all
    from scipy.spatial import cKDTree

    by_light = np.argsort(catalogue.vmag_centi, kind="stable")
    smallest_circle = min(radius for radius, _, _ in CIRCLES) * half_diagonal
    # so many circles have the area of the sphere
    circles = 4 / smallest_circle**2
    pool = np.sort(by_light[: int(POOL_PER_CIRCLE * circles) + 1000])
    rank = np.argsort(np.argsort(catalogue.vmag_centi[pool], kind="stable"))
    v = catalogue.directions(pool)
    brightest_first = np.argsort(rank)
    beacon = np.sort(brightest_first[: int(BEACONS * len(pool))])
    apart = brightest_first[well_apart(v[brightest_first], SHORTEST_SIDE * 2 * half_diagonal)]
    tree = cKDTree(v[apart])
    key = np.zeros(0, np.int64)
    for k, (radius, spacing, most) in enumerate(_affordable(half_diagonal)):
        key = np.union1d(key, _triples_of_circles(tree, radius * half_diagonal, spacing, most))
        progress("star triangles", (k + 1) / (len(CIRCLES) + 1))
    del tree
    corners, counter_clockwise, shape, longest_allowed, bin_start = _in_bins(v, apart, key, 2 * half_diagonal)
    progress("star triangles", 1.0)
    return TriangleCatalogue(
        star=pool.astype(np.int32),
        cell_start=cell_starts(np.searchsorted(pool, catalogue.zone_start), catalogue.ra_mas[pool] / 3.6e6),
        rank=rank.astype(np.int32),
        beacon=beacon.astype(np.int32),
        beacons=v[beacon],
        corners=corners,
        counter_clockwise=counter_clockwise,
        shape=shape,
        longest_allowed=longest_allowed,
        bin_start=bin_start,
    )


def well_apart(v: np.ndarray, nearest: float) -> np.ndarray:
    """Rows of the stars v (N, 3), brightest first, that have no brighter star within `nearest` rad.

    Close groups make no triangles among themselves, but would use up the stars of a circle.
    """
    from scipy.spatial import cKDTree

    pair = cKDTree(v).query_pairs(2 * np.sin(nearest / 2), output_type="ndarray")
    alone = np.ones(len(v), bool)
    alone[pair.max(1, initial=0)] = False
    return np.flatnonzero(alone)


def _affordable(half_diagonal: float) -> list[tuple[float, float, int]]:
    """CIRCLES with fewer stars where a small field would exceed MAX_TRIANGLES."""
    taken = [most for _, _, most in CIRCLES]
    circles = np.array([circle_count(radius * half_diagonal, spacing) for radius, spacing, _ in CIRCLES])
    while (made := circles * [comb(n, 3) for n in taken]).sum() > MAX_TRIANGLES:
        taken[int(made.argmax())] -= 1
    return [(radius, spacing, n) for (radius, spacing, _), n in zip(CIRCLES, taken, strict=True)]


def _triples_of_circles(tree: "cKDTree", radius: float, spacing: float, most: int) -> np.ndarray:
    """Keys of all triples among the `most` first rows of the cKDTree in each circle: (a n + b) n + c, a < b < c."""
    centres = spread_points(circle_count(radius, spacing))
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
            found.append(_distinct(((rows[:, i] * n + rows[:, j]) * n + rows[:, k]).ravel()))
    return _distinct(np.concatenate(found))


def _distinct(keys: np.ndarray) -> np.ndarray:
    """The distinct ones of keys (K,), ascending: `numpy.unique` takes fifty times as long for millions of integers."""
    keys = np.sort(keys)
    return keys[np.concatenate([[True], keys[1:] != keys[:-1]])] if len(keys) else keys


def circle_count(radius: float, spacing: float) -> int:
    """Number of circles of this radius (rad) on a sphere that lie spacing * radius apart."""
    return int(4 * np.pi / (spacing * radius) ** 2) + 50


def spread_points(n: int) -> np.ndarray:
    """Unit vectors (n, 3) spread almost evenly over the sphere, from south to north: a golden spiral."""
    k = np.arange(n)
    z = (2 * k + 1) / n - 1
    angle = k * (np.pi * (3 - np.sqrt(5)))
    level = np.sqrt(1 - z * z)
    return np.stack([level * np.cos(angle), level * np.sin(angle), z], -1)


def _in_bins(
    v: np.ndarray, rows: np.ndarray, triples: np.ndarray, longest_side: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Usable triangles, sorted by their bins: the columns of `TriangleCatalogue` from `corners` on."""
    n, parts = len(rows), []
    # in blocks, because all triangles together would take 500 MB
    for key in np.array_split(triples, len(triples) // BLOCK + 1):
        corner = rows[np.stack([key // (n * n), key // n % n, key % n], -1)]
        parts.append(_measured(v, corner, longest_side))
    corner, turn, code, bins = (np.concatenate(column) for column in zip(*parts, strict=True))
    del parts
    order = np.argsort(bins, kind="stable")
    starts = np.concatenate([[0], np.cumsum(np.bincount(bins, minlength=np.prod(BINS)))])
    return corner[order], turn[order], code[order], np.array([longest_side]), starts.astype(np.int32)


def _measured(
    v: np.ndarray, corner: np.ndarray, longest_side: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Triangles (M, 3) with usable sides, the corner of the largest angle first; their orientation, shape and bin."""
    length = opposite_sides(v[corner])
    good = (length.max(1) < longest_side) & (length.min(1) > SHORTEST_SIDE * longest_side)
    corner, length = corner[good], length[good]
    angle = angles(length)
    corner = np.take_along_axis(corner, np.argsort(-angle, axis=1, kind="stable"), 1)
    code = _coded(np.stack([angle.max(1), angle.min(1), length.max(1)], -1), longest_side)
    bins = np.ravel_multi_index(_bins(code).T, BINS)
    return (
        corner.astype(np.int32),
        counter_clockwise(v[corner]),
        code.astype(np.uint16),
        bins.astype(np.int32),
    )

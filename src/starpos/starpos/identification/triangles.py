# SPDX-License-Identifier: Apache-2.0
"""The catalogue of triangles of stars that is searched.

Triangles are found by their angles, as in the paper, because these hardly depend on the focal length. Every circle of the
field's size gives its own brightest stars, so that every field of the instrument has enough triangles.
"""

import math
from dataclasses import dataclass
from functools import cached_property
from math import comb

import numpy as np

from starpos.identification._circles import binned, distinct, triples_of_circles, well_apart
from starpos.identification._triangles import TriangleTable
from starpos.progress import Progress, quiet
from starpos.sky.catalogue import CELLS, ZONES, Catalogue, cell_starts
from starpos.table_cache import KeptTables, digest_of, rising

# Shortest side over the longest allowed one: the errors of centroids blur the angles of smaller triangles.
SHORTEST_SIDE = 0.03
# Shapes (largest angle 60..180 deg, smallest 0..60 deg, longest side 0..the longest allowed) are kept to 1/65536 of
# these ranges; the highest bits of the three are a triangle's bin.
CODES = 1 << 16
# Maximum error of the focal length (share), and of a triangle (sigma of its stars).
SCALE_TOLERANCE, TRIANGLE_SIGMA = 0.03, 3.0
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
# Limits, counted before duplicates of overlapping circles are removed. Beyond ENOUGH_TRIANGLES there are no larger
# circles. Beyond MAX_TRIANGLES fewer stars are taken of the smallest circles, down to MIN_TAKEN, and one less beyond
# twice as many triangles: the table of a field of 0.3 deg has 600 MB.
ENOUGH_TRIANGLES, MAX_TRIANGLES, MIN_TAKEN = 9_000_000, 16_000_000, 5


@dataclass(frozen=True, kw_only=True, eq=False)
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

    def check(self, catalogue_stars: int) -> None:
        """Raise ValueError for columns that do not match each other or the stars: compiled loops trust them."""
        stars, count = len(self.star), len(self.corners)
        if not (
            self.bin_start.shape == (np.prod(BINS) + 1,)
            and self.cell_start.shape == (ZONES * CELLS + 1,)
            and self.corners.shape == self.shape.shape == (count, 3)
            and self.counter_clockwise.shape == (count,)
            and self.rank.shape == self.star.shape == (stars,)
            and self.beacons.shape == (len(self.beacon), 3)
            and self.longest_allowed.shape == (1,)
        ):
            raise ValueError("the columns of the triangles are not of equal length")
        if not (
            self.longest_allowed[0] > 0
            and rising(self.bin_start, count)
            and rising(self.cell_start, stars)
            # so that the first and the last are the limits
            and bool(np.all(np.diff(self.star) > 0))
            and (stars == 0 or 0 <= self.star[0] <= self.star[-1] < catalogue_stars)
            and (count == 0 or 0 <= self.corners.min() <= self.corners.max() < stars)
            and bool(np.all(self.corners[:, 0] != self.corners[:, 1]))
            and (len(self.beacon) == 0 or 0 <= self.beacon.min() <= self.beacon.max() < stars)
        ):
            raise ValueError("the triangles are not sorted, or not of the catalogue's stars")

    @cached_property
    def compiled(self) -> TriangleTable:
        """The triangles, for compiled code."""
        return TriangleTable(self, CROWDED, SCALE_TOLERANCE, TRIANGLE_SIGMA)


def build(catalogue: Catalogue, half_diagonal: float, progress: Progress = quiet) -> TriangleCatalogue:
    """Triangles for a field of this half diagonal (rad), of the brightest stars of every circle over the sky.

    A circle takes its own brightest stars, however bright its neighbours are, so that every part of the sky has enough.
    """
    by_light = np.argsort(catalogue.vmag_centi, kind="stable")
    smallest_circle = min(radius for radius, _, _ in CIRCLES) * half_diagonal
    circles_on_sphere = 4 / smallest_circle**2
    pool = np.sort(by_light[: int(POOL_PER_CIRCLE * circles_on_sphere) + 1000])
    rank = np.argsort(np.argsort(catalogue.vmag_centi[pool], kind="stable"))
    v = catalogue.directions(pool)
    brightest_first = np.argsort(rank)
    beacon = np.sort(brightest_first[: int(BEACONS * len(pool))])
    apart = brightest_first[well_apart(v[brightest_first], SHORTEST_SIDE * 2 * half_diagonal)]
    triples = []
    taken = affordable(half_diagonal)
    for k, (radius, spacing, most) in enumerate(taken):
        centres = spread_points(circle_count(radius * half_diagonal, spacing))
        triples.append(triples_of_circles(v[apart], centres, radius * half_diagonal, most))
        progress("star triangles", (k + 1) / (len(taken) + 1))
    longest = 2 * half_diagonal
    first, others = distinct(*map(np.concatenate, zip(*triples, strict=True)), len(apart))
    # a node has little memory
    del triples
    corners, counter_clockwise, shape, bin_start = binned(
        v, apart.astype(np.int32), first, others, SHORTEST_SIDE * longest, longest, int(np.prod(BINS))
    )
    progress("star triangles", 1.0)
    built = TriangleCatalogue(
        star=pool.astype(np.int32),
        cell_start=cell_starts(np.searchsorted(pool, catalogue.zone_start), catalogue.ra_mas[pool] / 3.6e6),
        rank=rank.astype(np.int32),
        beacon=beacon.astype(np.int32),
        beacons=v[beacon],
        corners=corners,
        counter_clockwise=counter_clockwise,
        shape=shape,
        longest_allowed=np.array([longest]),
        bin_start=bin_start,
    )
    built.check(len(catalogue))
    return built


def affordable(half_diagonal: float) -> list[tuple[float, float, int]]:
    """CIRCLES that a field can afford; a small one without the larger ones, whose triangles seldom fit on a frame."""
    taken = list(CIRCLES)
    while len(taken) > 1 and _made(taken, half_diagonal) > ENOUGH_TRIANGLES:
        taken.pop()
    radius, spacing, most = taken[0]
    while _made(taken, half_diagonal) > MAX_TRIANGLES and most > MIN_TAKEN:
        most -= 1
        taken[0] = radius, spacing, most
    if _made(taken, half_diagonal) > 2 * MAX_TRIANGLES:
        taken[0] = radius, spacing, MIN_TAKEN - 1
    return taken


def _made(taken: list[tuple[float, float, int]], half_diagonal: float) -> int:
    """How many triangles circles make over the whole sky, before duplicates are removed."""
    return sum(circle_count(radius * half_diagonal, spacing) * comb(n, 3) for radius, spacing, n in taken)


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


# The number of the folder's name is the format version. Up to 10, tables of over 2 million stars may be wrong.
KEPT = KeptTables(TriangleCatalogue, "triangles-11-", "iiiifibufi", "triangles", 4)


def cached_triangles(
    catalogue: Catalogue, half_diagonal_rad: float, progress: Progress = quiet
) -> TriangleCatalogue:
    """The TriangleCatalogue for a field of this half diagonal (rad), memory-mapped from the cache; built if missing.

    The field is rounded up to steps of 5 %, so that a refined focal length does not need a new one.
    """
    half = 1.05 ** math.ceil(math.log(half_diagonal_rad) / math.log(1.05))
    settings = catalogue.fingerprint, half, affordable(half), POOL_PER_CIRCLE, BEACONS, SHORTEST_SIDE
    name = f"{np.degrees(2 * half):.2f}deg-{digest_of(settings)}"
    return KEPT.built(name, lambda: build(catalogue, half, progress), len(catalogue))

# SPDX-License-Identifier: Apache-2.0
"""Quads of bright stars of every size, by their shape: they determine the scale of an unknown frame.

As in astrometry.net (Lang et al. 2010, AJ 139, 1782) four stars have a shape that does not depend on the scale, and
hardly any other four have it too. Here the shape is the lengths of five sides over the length of the longest.
"""

from dataclasses import dataclass
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from starpos.identification._circles import well_apart
from starpos.identification._quads import near
from starpos.identification.triangles import circle_count, spread_points
from starpos.progress import Progress, quiet
from starpos.sky.catalogue import Catalogue

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

# Circles over the whole sky: radius in deg, and how many of the brightest stars in each make quads.
LEVELS = (
    (0.5, 5), (0.75, 6), (1.12, 6), (1.7, 7), (2.55, 7), (3.8, 8),
    (5.7, 8), (8.6, 8), (12.9, 8), (19.4, 8), (29.0, 8),
)  # fmt: skip
SPACING, STARS_PER_CIRCLE = 0.7, 20
# The longest side over the circle's radius is at least this, the shortest over the longest one this.
MIN_SIDE, SHORTEST = 0.6, 0.08
# Shapes are kept to 1/65535; these are the bins of four of their sides, and of the logarithm of the longest.
CODES, BINS, SIZE_BINS = 65535, 12, 56
SIZES_RAD = np.log(0.004), np.log(1.2)
# Maximum number of similar pairs of quads for one focal length: more come from close stars and add no information.
MAX_ALIKE = 2000
# Which pairs of a quad's stars its sides are: AB is the longest.
SIDES = np.array(list(combinations(range(4), 2)))


@dataclass(frozen=True, kw_only=True)
class QuadCatalogue:
    """Q quads of the catalogue's stars, in bins of their shape.

    corners    (Q, 4): rows of the star catalogue, in the order that `shapes` gives them
    shape      (Q, 5): sides AC, AD, BC, BD, CD over AB, in CODES
    log_size   (Q,): logarithm of AB in rad
    bin_start  (bins + 1,): first quad of each bin
    """

    corners: np.ndarray
    shape: np.ndarray
    log_size: np.ndarray
    bin_start: np.ndarray

    def near(
        self, shape: np.ndarray, tolerance: np.ndarray, log_size: np.ndarray, log_tolerance: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """Quads within tolerance (N,) of shapes (N, 5) and within log_tolerance of their sizes (N,), as logarithms.

        Returns arrays of query (M,) and quad (M,), M at most MAX_ALIKE.
        """
        query, quad = near(
            self.bin_start,
            self.shape,
            self.log_size,
            np.ascontiguousarray(shape, float),
            np.ascontiguousarray(tolerance, float),
            np.ascontiguousarray(log_size, float),
            log_tolerance,
            CODES,
            BINS,
            SIZE_BINS,
            *SIZES_RAD,
            MAX_ALIKE,
        )
        return query, quad


def shapes(v: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Order (M, 4), shape (M, 5) and size (M,) of quads of unit vectors v (M, 4, 3).

    A and B are the farthest from each other, A the one nearer to the other two, C nearer to A than D. Sizes and sides are
    chords.
    """
    side = np.linalg.norm(v[:, SIDES[:, 0]] - v[:, SIDES[:, 1]], axis=2)
    length = np.zeros((len(v), 4, 4))
    length[:, SIDES[:, 0], SIDES[:, 1]] = length[:, SIDES[:, 1], SIDES[:, 0]] = side
    longest = side.argmax(1)
    each = np.arange(len(v))
    a, b = SIDES[longest].T
    # the opposite side joins the other two: the pairs are in such an order
    c, d = SIDES[5 - longest].T
    swap = length[each, a, c] + length[each, a, d] > length[each, b, c] + length[each, b, d]
    a, b = np.where(swap, b, a), np.where(swap, a, b)
    swap = length[each, a, c] > length[each, a, d]
    c, d = np.where(swap, d, c), np.where(swap, c, d)
    size = side.max(1)
    ratio = [length[each, i, j] / size for i, j in ((a, c), (a, d), (b, c), (b, d), (c, d))]
    return np.stack([a, b, c, d], 1), np.stack(ratio, 1), size


def build(catalogue: Catalogue, progress: Progress = quiet) -> QuadCatalogue:
    """The quads of the brightest stars of every circle of LEVELS over the sky."""
    # slow to import, and mostly the cache has all
    from scipy.spatial import cKDTree

    by_light = np.argsort(catalogue.vmag_centi, kind="stable")
    parts = []
    for k, (degrees, most) in enumerate(LEVELS):
        radius = np.radians(degrees)
        pool = by_light[: int(STARS_PER_CIRCLE * 4 / radius**2)]
        v = catalogue.directions(pool)
        alone = well_apart(v, SHORTEST * MIN_SIDE * radius)
        pool, v = pool[alone], v[alone]
        parts.append(_quads(cKDTree(v), v, pool, radius, most))
        progress("star quads", (k + 1) / (len(LEVELS) + 1))
    corners, shape, log_size = (np.concatenate(column) for column in zip(*parts, strict=True))
    key = _key(_bin(shape[:, :4])) + _size_bin(log_size)
    order = np.argsort(key, kind="stable")
    starts = np.concatenate([[0], np.cumsum(np.bincount(key, minlength=BINS**4 * SIZE_BINS))])
    progress("star quads", 1.0)
    return QuadCatalogue(
        corners=corners[order],
        shape=np.rint(shape[order] * CODES).astype(np.uint16),
        log_size=log_size[order],
        bin_start=starts.astype(np.int32),
    )


def _quads(
    tree: "cKDTree", v: np.ndarray, pool: np.ndarray, radius: float, most: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Corners, shapes and logarithms of sizes of the quads of the `most` brightest stars of each circle."""
    centres, chord, found = spread_points(circle_count(radius, SPACING)), 2 * np.sin(radius / 2), []
    for block in np.array_split(centres, max(1, len(centres) // 1000)):
        lists = [near[:most] for near in tree.query_ball_point(block, chord, return_sorted=True)]
        rows = np.array([near for near in lists if len(near) == most], np.int64).reshape(-1, most)
        found.append(rows[:, np.array(list(combinations(range(most), 4)))].reshape(-1, 4))
    rows = _distinct(np.concatenate(found))
    corners, shape, log_size = [], [], []
    for block in np.array_split(rows, len(rows) // 200_000 + 1):
        order, ratio, size = shapes(v[block])
        good = (size > MIN_SIDE * radius) & (ratio.min(1) > SHORTEST)
        corners.append(pool[np.take_along_axis(block, order, 1)[good]].astype(np.int32))
        shape.append(ratio[good].astype(np.float32))
        log_size.append(np.log(size[good]).astype(np.float32))
    return np.concatenate(corners), np.concatenate(shape), np.concatenate(log_size)


def _distinct(rows: np.ndarray) -> np.ndarray:
    """The distinct ones of ascending rows (K, 4): neighbouring circles share most of their quads."""
    mixed = (rows.astype(np.uint64) + np.uint64(1)) * np.uint64(0x9E3779B97F4A7C15)
    mixed ^= mixed >> np.uint64(29)
    key = (mixed * np.array([1, 0xBF58476D1CE4E5B9, 0x94D049BB133111EB, 0xD6E8FEB86659FD93], np.uint64)).sum(
        1
    )
    order = np.argsort(key)
    key = key[order]
    return rows[order[np.concatenate([[True], key[1:] != key[:-1]])]]


def _bin(shape: np.ndarray) -> np.ndarray:
    return np.clip((shape * BINS).astype(np.int32), 0, BINS - 1)


def _size_bin(log_size: np.ndarray) -> np.ndarray:
    low, high = SIZES_RAD
    return np.clip(((log_size - low) * (SIZE_BINS / (high - low))).astype(np.int32), 0, SIZE_BINS - 1)


def _key(bins: np.ndarray) -> np.ndarray:
    """Number of the first bin of a shape, whose sizes follow."""
    a, b, c, d = bins.T
    return (((a * BINS + b) * BINS + c) * BINS + d) * SIZE_BINS

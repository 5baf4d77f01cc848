# SPDX-License-Identifier: Apache-2.0
"""Quads of bright stars of every size, by their shape: they determine the scale of an unknown frame.

As in astrometry.net (Lang et al. 2010, AJ 139, 1782) four stars have a shape that does not depend on the scale, and
hardly any other four have it too. Here the shape is the lengths of five sides over the length of the longest. Quads of a
frame's brightest stars that look like quads of the sky give poses, those first that most agree on.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from starpos import rotation
from starpos.frozen import at_once
from starpos.identification._circles import well_apart
from starpos.identification._frame import FrameStars
from starpos.identification._quads import near
from starpos.identification.pose import MATCH_SIGMA, Pose, directions
from starpos.identification.sky import Sky
from starpos.identification.triangles import circle_count, spread_points
from starpos.progress import Progress, quiet
from starpos.sky.catalogue import Catalogue
from starpos.table_cache import KeptTables, digest_of, rising

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
SIDE_OF = np.zeros((4, 4), int)
SIDE_OF[SIDES[:, 0], SIDES[:, 1]] = SIDE_OF[SIDES[:, 1], SIDES[:, 0]] = range(6)


@at_once
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

    def check(self, catalogue_stars: int) -> None:
        """Raise ValueError for columns that do not match each other or the stars: compiled loops trust them."""
        count = len(self.corners)
        if not (
            self.corners.shape == (count, 4)
            and self.shape.shape == (count, 5)
            and self.log_size.shape == (count,)
            and self.bin_start.shape == (BINS**4 * SIZE_BINS + 1,)
            and rising(self.bin_start, count)
            and (count == 0 or 0 <= self.corners.min() <= self.corners.max() < catalogue_stars)
        ):
            raise ValueError("the quads are not sorted, or not of the catalogue's stars")

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


def chords(v: np.ndarray) -> np.ndarray:
    """The six sides (M, 6) of quads of unit vectors v (M, 4, 3), in the order of SIDES."""
    return np.linalg.norm(v[:, SIDES[:, 0]] - v[:, SIDES[:, 1]], axis=2)


def shapes(side: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Order (M, 4), shape (M, 5) and size (M,) of quads of sides (M, 6), as `chords` has them.

    A and B are the farthest from each other, A the one nearer to the other two, C nearer to A than D. Sizes and sides are
    chords.
    """
    longest = side.argmax(1)
    each = np.arange(len(side))

    def between(i: np.ndarray, j: np.ndarray) -> np.ndarray:
        return side[each, SIDE_OF[i, j]]

    a, b = SIDES[longest].T
    # the opposite side joins the other two: the pairs are in such an order
    c, d = SIDES[5 - longest].T
    swap = between(a, c) + between(a, d) > between(b, c) + between(b, d)
    a, b = np.where(swap, b, a), np.where(swap, a, b)
    swap = between(a, c) > between(a, d)
    c, d = np.where(swap, d, c), np.where(swap, c, d)
    size = side[each, longest]
    ratio = [between(i, j) / size for i, j in ((a, c), (a, d), (b, c), (b, d), (c, d))]
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
    key = _bins(shape, log_size)
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
        order, ratio, size = shapes(chords(v[block]))
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


def _bins(shape: np.ndarray, log_size: np.ndarray) -> np.ndarray:
    """Numbers (Q,) of the bins of shapes (Q, 5) and of the logarithms of sizes (Q,), which follow each other."""
    low, high = SIZES_RAD
    sides = (shape[:, :4] * BINS).astype(np.int32)
    size = ((log_size - low) * (SIZE_BINS / (high - low))).astype(np.int32)
    bins = np.ravel_multi_index((*sides.T, size), (BINS, BINS, BINS, BINS, SIZE_BINS), mode="clip")
    return bins.astype(np.int32)


# The number of the folder's name is the format version.
KEPT = KeptTables(QuadCatalogue, "quads-1-", "iufi", "star quads")


def is_built(catalogue: Catalogue) -> bool:
    """Whether `cached_quads` need not build."""
    return KEPT.folder(_name(catalogue)).is_dir()


def cached_quads(catalogue: Catalogue, progress: Progress = quiet) -> QuadCatalogue:
    """The QuadCatalogue of a star catalogue, memory-mapped from the cache (180 MB); built, in about 20 s, if missing."""
    return KEPT.built(_name(catalogue), lambda: build(catalogue, progress), len(catalogue))


def _name(catalogue: Catalogue) -> str:
    return digest_of(
        (
            catalogue.fingerprint,
            LEVELS,
            SPACING,
            STARS_PER_CIRCLE,
            MIN_SIDE,
            SHORTEST,
            BINS,
            SIZE_BINS,
            SIZES_RAD,
        )
    )


# Sides of quads over the longest may be off by this besides the errors of the stars: lenses bend.
LENS = 0.003
QUAD_SIGMA = 3.0
# Poses agree if their axes differ by this share of the field and their focal lengths by this share.
SAME_AXIS, SAME_FOCAL = 0.03, 0.03
# A focal length may be outside the range that is searched by this share, once it is fitted.
BEYOND = 0.1


# K pairs of quads that look alike: rows (K, 4) of the frame's stars, rows (K, 4) of the star catalogue, and the focal
# lengths (K,) at which they do.
Matches = tuple[np.ndarray, np.ndarray, np.ndarray]


def matches(
    field: FrameStars, quads: QuadCatalogue, stars: int, error_px: float, focal_px: float, step: float
) -> Matches:
    """Quads of the frame's brightest stars, and similar quads of the sky at a focal length.

    error_px: of the stars, besides their own.  step: the share by which the true focal length may differ.
    """
    four = _fours(stars)
    v = directions(field.xy[:1, :stars], np.array([focal_px]))[0]
    apart = np.linalg.norm(v[:, None] - v, axis=2)
    side = apart[four[:, SIDES[:, 0]], four[:, SIDES[:, 1]]]
    size = side.max(1)
    error = QUAD_SIGMA * np.hypot(error_px, field.sigma[four].max(1)) / (focal_px * size)
    # a lower limit than the catalogue's
    use = np.flatnonzero((side.min(1) > 0.8 * SHORTEST * size) & (error < 0.03))
    # the best known first: the number of look-ups is limited
    use = use[np.argsort(error[use], kind="stable")]
    order, shape, size = shapes(side[use])
    query, quad = quads.near(shape, error[use] + LENS, np.log(size), step + 0.01)
    star = np.take_along_axis(four[use[query]], order[query], 1)
    return star, quads.corners[quad], np.full(len(query), focal_px)


@at_once
@dataclass(frozen=True)
class QuadPoses:
    """K poses of a frame, as `Pose` has each, and the quads of its stars (K, 4) from which they come.

    attitude (K, 3, 3), focal_px (K,), mirrored (K,)
    """

    attitude: np.ndarray
    focal_px: np.ndarray
    mirrored: np.ndarray
    star: np.ndarray

    @classmethod
    def of(
        cls,
        field: FrameStars,
        sky: Sky,
        found: Sequence[Matches],
        error_px: float,
        focal_range: tuple[float, float],
    ) -> "QuadPoses":
        """The poses of matches by which their four stars are in their places, with focal lengths in a range."""
        star, corner, focal = map(np.concatenate, zip(*found, strict=True))
        w = sky.directions(corner.ravel()).reshape(-1, 4, 3)
        seen = directions(field.xy[0][star], focal)
        mirrored = (_turn(seen[:, :3]) > 0) != (_turn(w[:, :3]) > 0)
        xy = field.xy[mirrored.astype(int)[:, None], star]
        wanted = chords(w).sum(1)
        for _ in range(3):
            focal = focal * chords(directions(xy, focal)).sum(1) / wanted
        attitude = rotation.best_rotation(w, directions(xy, focal))
        u = np.einsum("kij,knj->kni", attitude, w)
        off = u[..., :2] * (focal[:, None, None] / np.maximum(u[..., 2:], 1e-6)) - xy
        off_px = np.sqrt(np.square(off).sum(2).max(1))
        error = np.hypot(error_px, field.sigma[star].max(1)) if len(star) else np.zeros(0)
        low, high = focal_range
        good = (off_px < QUAD_SIGMA * error) & (focal > (1 - BEYOND) * low) & (focal < (1 + BEYOND) * high)
        return cls(attitude[good], focal[good], mirrored[good], star[good])

    @classmethod
    def together(cls, parts: Sequence["QuadPoses"]) -> "QuadPoses":
        """All poses of several parts, at least one."""
        return cls(*map(np.concatenate, zip(*(vars(p).values() for p in parts), strict=True)))

    def __getitem__(self, k: int) -> Pose:
        return Pose(self.attitude[k], float(self.focal_px[k]), bool(self.mirrored[k]))

    def __len__(self) -> int:
        return len(self.focal_px)

    def radius_px(self, field: FrameStars, k: int, error_px: float) -> np.ndarray:
        """Distance (N,) px by which each star may be off by pose k: it grows with that from the quad's stars."""
        xy = field.xy[int(self.mirrored[k])]
        of_quad = xy[self.star[k]]
        middle = of_quad.mean(0)
        size2 = max(float(np.square(of_quad - middle).sum() / 4), 1.0)
        away2 = np.square(xy - middle).sum(1)
        return MATCH_SIGMA * np.hypot(field.sigma, error_px) * np.sqrt(1 + away2 / size2)

    def most_agreed(self, half_diagonal_px: float, most: int) -> list[int]:
        """Rows of the poses with most votes, one of each group that agrees, up to a maximum number."""
        from scipy.spatial import cKDTree

        if not len(self):
            return []
        place = np.concatenate(
            [
                self.attitude[:, 2] * (self.focal_px / (SAME_AXIS * half_diagonal_px))[:, None],
                np.log(self.focal_px)[:, None] / SAME_FOCAL,
                10.0 * self.mirrored[:, None],
            ],
            axis=1,
        )
        tree = cKDTree(place)
        votes = tree.query_ball_point(place, 1.0, return_length=True)
        rows: list[int] = []
        taken = np.zeros(len(place), bool)
        for k in np.argsort(-votes, kind="stable").tolist():
            if not taken[k]:
                rows.append(k)
                taken[tree.query_ball_point(place[k], 1.0)] = True
                if len(rows) == most:
                    break
        return rows


@lru_cache(maxsize=8)
def _fours(n: int) -> np.ndarray:
    """All sets (F, 4) of four of 0..n-1."""
    return np.array(list(combinations(range(n), 4)), int).reshape(-1, 4)


def _turn(v: np.ndarray) -> np.ndarray:
    """Determinants (K,) of triangles (K, 3, 3): their signs are their orientations."""
    return np.einsum("ki,ki->k", v[:, 0], np.cross(v[:, 1], v[:, 2]))

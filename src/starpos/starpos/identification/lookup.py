# SPDX-License-Identifier: Apache-2.0
"""Candidates: pairs of a triangle of a frame's brightest stars and a catalogue triangle of the same shape."""

from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations

import numpy as np

from starpos.identification.evidence import SCALE_TOLERANCE
from starpos.identification.pose import FrameStars, directions
from starpos.identification.triangles import TriangleCatalogue, angles, counter_clockwise, opposite_sides

# With larger errors of the centroids a candidate counts only if another one supports it.
LOOSE_PX = 1.0
TRIANGLE_SIGMA = 3.0
# A look-up is limited to triangles for which so many candidates are expected.
MOST_CANDIDATES = 25_000
# The same limit in a crowd of false stars; so many candidates, those best supported, are looked at there.
MOST_IN_CROWD, MOST_SUPPORTED = 60_000, 40


@dataclass(frozen=True)
class Candidates:
    """K candidates, best supported first.

    star      (K, 3): rows of the frame's stars
    corner    (K, 3): rows of the triangle catalogue's stars
    mirrored  (K,): whether the two triangles have opposite orientations
    """

    star: np.ndarray
    corner: np.ndarray
    mirrored: np.ndarray

    def __len__(self) -> int:
        return len(self.mirrored)

    def __getitem__(self, k: slice) -> "Candidates":
        return Candidates(self.star[k], self.corner[k], self.mirrored[k])


class Lookup:
    """Look up a frame's triangles, none of them twice with the same error of the centroids."""

    def __init__(self, field: FrameStars, table: TriangleCatalogue) -> None:
        self.field, self.table = field, table
        self.v = directions(field.xy[:1], np.array([field.focal_px]))[0]
        self._done: dict[float, int] = {}

    def candidates(self, stars: int, error_px: float) -> Candidates:
        """Candidates for those triangles of the `stars` brightest that were not yet looked up with this error."""
        done = self._done.get(error_px, 0)
        triples = _triples(stars)[done:]
        self._done[error_px] = done + len(triples)
        error = np.hypot(error_px, self.field.sigma[triples].max(1)) / self.field.focal_px
        star, shape, tolerance = _shapes(self.v, triples, error)
        # poor centroids fit too many triangles: then only those of the brightest stars are looked up
        few = np.cumsum(self.table.expected(tolerance)) < MOST_CANDIDATES
        star, shape, tolerance = star[few], shape[few], tolerance[few]
        query, found = self.table.near(shape, tolerance)
        star, corner = star[query], self.table.corners[found]
        mirrored = self.table.counter_clockwise[found] != counter_clockwise(self.v[star])
        if not len(star):
            return Candidates(star, corner, mirrored)
        support = _shared_sides(star, corner, mirrored)
        size = np.abs(np.log(self.table.longest(found) / shape[query, 2]))
        order = np.lexsort((size, -support))
        if error_px > LOOSE_PX:
            order = order[support[order] > 0]
        return Candidates(star[order], corner[order], mirrored[order])

    def supported(self, stars: int, error_px: float) -> Candidates:
        """The candidates, at most MOST_SUPPORTED, that most others support, of all triangles of the `stars` brightest.

        Where most of these stars are false, nearly all candidates are chance, but chance supports few. Only the triangles
        that chance matches least are looked up.
        """
        triples = _triples(stars)
        error = np.hypot(error_px, self.field.sigma[triples].max(1)) / self.field.focal_px
        star, shape, tolerance = _shapes(self.v, triples, error)
        expected = self.table.expected(tolerance)
        rarest = np.argsort(expected)
        rarest = rarest[expected[rarest].cumsum() < MOST_IN_CROWD]
        query, found = self.table.near(shape[rarest], tolerance[rarest])
        star, corner = star[rarest[query]], self.table.corners[found]
        mirrored = self.table.counter_clockwise[found] != counter_clockwise(self.v[star])
        support = _shared_sides(star, corner, mirrored)
        order = np.argsort(-support, kind="stable")[:MOST_SUPPORTED]
        order = order[support[order] > 1]
        return Candidates(star[order], corner[order], mirrored[order])


@lru_cache(maxsize=32)
def _triples(n: int) -> np.ndarray:
    """All triples (T, 3) of 0..n-1, those of the brightest stars first."""
    t = np.array(list(combinations(range(n), 3)), int).reshape(-1, 3)
    return t[np.lexsort((t.sum(1), t.max(1)))]


def _shapes(
    v: np.ndarray, triples: np.ndarray, error: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Queries for `TriangleCatalogue.near`: star (Q, 3), shape (Q, 3) and tolerance (Q, 3).

    The corner of the largest angle comes first, that of the smallest last. If two angles are equal within the error, both
    orders of the corners are there.
    """
    side = opposite_sides(v[triples])
    angle = angles(side)
    order = np.arange(len(triples))[:, None], np.argsort(-angle, axis=1, kind="stable")
    triples, angle, side = triples[order], angle[order], side[order]
    a, b, c = np.maximum(side.T, 1e-9)
    error = TRIANGLE_SIGMA * error
    largest = error * np.sqrt(1 / b**2 + 1 / c**2 + (a / (b * c)) ** 2)
    smallest = error * np.sqrt(1 / a**2 + 1 / b**2 + (c / (a * b)) ** 2)
    usable = (smallest < 0.1) & (largest < 0.2)
    first = usable & (angle[:, 0] - angle[:, 1] < 2 * largest)
    last = usable & (angle[:, 1] - angle[:, 2] < 2 * largest)
    star = np.concatenate([triples[usable], triples[first][:, [1, 0, 2]], triples[last][:, [0, 2, 1]]])
    row = np.concatenate([np.flatnonzero(k) for k in (usable, first, last)])
    shape = np.stack([angle[:, 0], angle[:, 2], a], -1)[row]
    tolerance = np.stack([largest, smallest, SCALE_TOLERANCE * a + error], -1)[row]
    return star, shape, tolerance


def _shared_sides(star: np.ndarray, corner: np.ndarray, mirrored: np.ndarray) -> np.ndarray:
    """Number (M,) of other candidates that share a side (two stars with the same two identities) with each."""
    # a detection and its identity become one scrambled number; a side is the sum of two, in either order
    mixed = (star.astype(np.uint64) << np.uint64(40)) | corner.astype(np.uint64)
    mixed = (mixed + np.uint64(1)) * np.uint64(0x9E3779B97F4A7C15)
    mixed ^= mixed >> np.uint64(29)
    mixed *= np.uint64(0xBF58476D1CE4E5B9)
    key = mixed + mixed[:, [1, 2, 0]] + mirrored.astype(np.uint64)[:, None]
    # several times faster than numpy.unique
    order = np.argsort(key, axis=None)
    ordered = key.ravel()[order]
    first = np.flatnonzero(np.concatenate([[True], ordered[1:] != ordered[:-1]]))
    count = np.diff(np.append(first, len(ordered)))
    others = np.empty(len(ordered), int)
    others[order] = np.repeat(count - 1, count)
    return others.reshape(key.shape).sum(1)

# SPDX-License-Identifier: Apache-2.0
"""Candidates: pairs of a triangle of a frame's brightest stars and a catalogue triangle of the same shape."""

from dataclasses import dataclass

import numpy as np

from starpos.identification.pose import FrameStars
from starpos.identification.triangles import TriangleCatalogue

# With larger errors of the centroids a candidate counts only if another one supports it.
LOOSE_PX = 1.0
# A look-up is limited to triangles for which so many candidates are expected; so many, the best ones, are looked at.
MOST_CANDIDATES, MOST_LOOKED_AT = 25_000, 25
# The same in a crowd of false stars.
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
        self.frame, self.table = field.compiled, table.compiled
        self._done: dict[float, int] = {}

    def candidates(self, stars: int, error_px: float) -> Candidates:
        """The best candidates for those triangles of the `stars` brightest that were not yet looked up with this error.

        Poor centroids fit too many triangles: then only those of the brightest stars are looked up.
        """
        done, self._done[error_px] = self._done.get(error_px, 0), stars
        loose = error_px > LOOSE_PX
        return Candidates(
            *self.table.candidates(self.frame, done, stars, error_px, MOST_CANDIDATES, MOST_LOOKED_AT, loose)
        )

    def supported(self, stars: int, error_px: float) -> Candidates:
        """The candidates that most others support, at least two, of all triangles of the `stars` brightest.

        Where most of these stars are false, nearly all candidates are chance, but chance supports few. Only the triangles
        that chance matches least are looked up.
        """
        return Candidates(*self.table.supported(self.frame, stars, error_px, MOST_IN_CROWD, MOST_SUPPORTED))

# SPDX-License-Identifier: Apache-2.0
"""The stars of the catalogue in the directions in which they are seen at a date."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from starpos.earth.orientation import earth_motion
from starpos.frozen import at_once
from starpos.identification._sky import StarTable
from starpos.identification.triangles import TriangleCatalogue
from starpos.sky.catalogue import EPOCH, Catalogue

PAGE_BYTES = 4096


@at_once
@dataclass(frozen=True)
class Sky:
    """The catalogue at a date: with proper motion to `year` and aberration by `velocity` (3,) in units of c.

    Without triangles nothing is found lost in space.
    """

    catalogue: Catalogue
    triangles: TriangleCatalogue | None
    year: float = EPOCH
    velocity: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @classmethod
    def at(cls, catalogue: Catalogue, triangles: TriangleCatalogue | None, utc_unix_s: float | None) -> "Sky":
        """The sky at a time; if it is unknown (None), at J2000 without aberration."""
        if utc_unix_s is None:
            return _undated(catalogue, triangles)
        year, velocity = earth_motion(utc_unix_s)
        return cls(catalogue, triangles, year, tuple(velocity))

    @property
    def stars(self) -> StarTable:
        """The catalogue, for compiled code."""
        return _stars(self.catalogue)

    @property
    def years(self) -> float:
        """Julian years since the catalogue's epoch."""
        return self.year - EPOCH

    def directions(self, index: np.ndarray) -> np.ndarray:
        """Unit vectors (n, 3) of the catalogue's rows `index` (n,)."""
        return self.stars.directions(np.asarray(index, np.intp), self.years, self.velocity)


@lru_cache(maxsize=4)
def _undated(catalogue: Catalogue, triangles: TriangleCatalogue | None) -> Sky:
    return Sky(catalogue, triangles)


@lru_cache(maxsize=2)
def _stars(catalogue: Catalogue) -> StarTable:
    return StarTable(catalogue)


@lru_cache(maxsize=4)
def touch(triangles: TriangleCatalogue) -> None:
    """Read a number of each page of the mapped table: a page that is new to the process takes longer than a look-up."""
    triangles.shape.ravel()[:: PAGE_BYTES // triangles.shape.itemsize].max(initial=0)
    triangles.counter_clockwise[::PAGE_BYTES].any()

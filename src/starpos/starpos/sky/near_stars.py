# SPDX-License-Identifier: Apache-2.0
"""Parallaxes of the near stars, which Tycho-2 does not have.

They are Hipparcos' stars (ESA SP-1200, 1997) of MIN_MAS and more, and stars within 8 arcsec of one. The table is made by
tools/data/near_stars.py from Stellarium's list, which has later values for some. Hipparcos' own err by 1 to 3 mas, of
some pairs more.
"""

from functools import lru_cache
from pathlib import Path

import numpy as np

MIN_MAS = 100.0
# Columns tyc1, tyc2, tyc3, parallax_mas.
PARALLAXES = Path(__file__).with_name("data") / "near_stars.csv"


def parallaxes_mas(tyc: np.ndarray) -> np.ndarray:
    """Parallaxes (N,) of stars with these Tycho identifiers (N, 3), mas; 0 for those that are not near."""
    number, parallax = _table()
    wanted = _numbers(tyc)
    row = np.minimum(np.searchsorted(number, wanted), len(number) - 1)
    return np.where(number[row] == wanted, parallax[row], 0.0)


@lru_cache(maxsize=1)
def _table() -> tuple[np.ndarray, np.ndarray]:
    """Numbers (M,) of the near stars, rising, and their parallaxes (M,) in mas."""
    rows = np.loadtxt(PARALLAXES, delimiter=",", skiprows=1, ndmin=2)
    number = _numbers(rows[:, :3])
    order = np.argsort(number)
    return number[order], rows[order, 3]


def _numbers(tyc: np.ndarray) -> np.ndarray:
    """One number (N,) for each identifier (N, 3)."""
    region, within, component = np.asarray(tyc, np.int64).T
    return (region << 20) + (within << 4) + component

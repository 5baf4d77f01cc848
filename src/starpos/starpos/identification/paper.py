# SPDX-License-Identifier: Apache-2.0
"""Count the paper's triangle catalogue again: its stars, its triangles, and the triangle whose angles it prints."""

from pathlib import Path

import numpy as np
from scipy.sparse import csr_array
from scipy.spatial import cKDTree

from starpos.errors import CatalogueError
from starpos.identification.triangles import angles, opposite_sides
from starpos.rotation import unit_vector
from starpos.sky.catalogue import EPOCH, Catalogue
from starpos.units import MAS

LIMIT_MAG = 7.0
# The diagonal of 3.43 x 2.30 deg.
LONGEST_SIDE_DEG = 4.13
PRINTED_TRIANGLES = 951_181
# The numbers that its data give.
STARS, TRIANGLES = 15_236, 952_970
# Angles (rad) of the triangle it prints, and its stars; the star numbers it prints are others.
ANGLES = (2.27327, 0.634202, 0.234213)
CORNERS = ("HIP 99002", "HIP 98753 A", "HIP 99145")
EXCEPTIONS = Path(__file__).with_name("data") / "paper_stars.csv"

# Component A of HIP 98753 is TYC 2682-3566-1, the brighter of a pair 1.9 arcsec apart that the catalogue merges. Its
# observed place and epoch are Tycho-2's; the proper motion (mas/yr, in right ascension times cos(dec)) is the pair's.
_A_RA_DEG, _A_DEC_DEG, _A_EPOCH = 300.87250833, 36.02515667, 1991.6
_A_PM_RA, _A_PM_DEC = -10.7, -4.3
# Errors of the place and of the motion, which belongs to the pair and not to A alone.
_A_SIGMA_MAS = np.hypot(4.0, 2.6 * (EPOCH - _A_EPOCH))


def plain_cut(catalogue: Catalogue) -> np.ndarray:
    """Rows of all stars brighter than LIMIT_MAG with a HIP number, nearly the same as the paper's stars."""
    return np.flatnonzero((catalogue.vmag_centi < 100 * LIMIT_MAG) & (catalogue.hip > 0))


def stars(catalogue: Catalogue) -> np.ndarray:
    """Rows of the paper's stars, from Tycho-2's main table; a merged pair comes twice if the paper has both stars.

    EXCEPTIONS holds the stars that the compact catalogue cannot distinguish; `tools/data/paper_stars.py` makes it from
    the original files. CatalogueError if the catalogue lacks some of them.
    """
    *tyc, times = np.loadtxt(EXCEPTIONS, int, delimiter=",", skiprows=2, unpack=True)
    there = _number(catalogue.tyc.T.astype(int))
    order = np.argsort(there)
    place = np.searchsorted(there[order], _number(tyc)).clip(max=len(there) - 1)
    row = order[place]
    if not np.array_equal(there[row], _number(tyc)):
        raise CatalogueError(
            f"the catalogue in use lacks stars brighter than V = {LIMIT_MAG:g}: unset STARPOS_CATALOGUE, or build it anew"
        )
    return np.concatenate([np.setdiff1d(plain_cut(catalogue), row), np.repeat(row, times)])


def _number(tyc: np.ndarray | list[np.ndarray]) -> np.ndarray:
    """A single number for each Tycho identifier (3, N)."""
    return (tyc[0] * 100_000 + tyc[1]) * 10 + tyc[2]


def count_triangles(v: np.ndarray, longest_side_rad: float) -> int:
    """Number of triples of the unit vectors v (N, 3) that have all sides below longest_side_rad.

    Each pair is directed from the lower row to the higher one. So each triangle is counted once, as a path of two pairs
    whose ends are a pair too.
    """
    pairs = cKDTree(v).query_pairs(2 * np.sin(longest_side_rad / 2), output_type="ndarray")
    near = csr_array((np.ones(len(pairs), np.int64), (pairs[:, 0], pairs[:, 1])), (len(v), len(v)))
    return int(((near @ near) * near).sum())


def angles_of_printed(catalogue: Catalogue) -> tuple[np.ndarray, np.ndarray]:
    """Angles (3,) in rad, at CORNERS, of the triangle whose angles the paper prints, and their sigma (3,).

    The sigma comes from the place of component A at J2000, known to 22 mas.
    """
    first, last = (_named(catalogue, int(CORNERS[k].split()[1])) for k in (0, 2))
    ra, dec = np.radians([_A_RA_DEG, _A_DEC_DEG])
    years = EPOCH - _A_EPOCH
    ra, dec = ra + _A_PM_RA * MAS * years / np.cos(dec), dec + _A_PM_DEC * MAS * years

    def at(ra: float, dec: float) -> np.ndarray:
        return angles(opposite_sides(np.stack([first, unit_vector(ra, dec), last])))

    here, step = at(ra, dec), _A_SIGMA_MAS * MAS
    return here, np.hypot(at(ra + step / np.cos(dec), dec) - here, at(ra, dec + step) - here)


def _named(catalogue: Catalogue, hip: int) -> np.ndarray:
    row = np.flatnonzero(catalogue.hip == hip)
    if len(row) != 1:
        raise CatalogueError(f"the catalogue in use has no HIP {hip}: unset STARPOS_CATALOGUE")
    return catalogue.directions(row)[0]

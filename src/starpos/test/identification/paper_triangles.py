# SPDX-License-Identifier: Apache-2.0
"""Spherical triangles by the paper's formulas, its catalogue of them, and the triangle whose angles it prints."""

from pathlib import Path

import numpy as np
from scipy.sparse import csr_array
from scipy.spatial import cKDTree

from starpos.rotation import unit_vector
from starpos.sky.catalogue import EPOCH
from starpos.units import MAS

LIMIT_MAG = 7.0
# the diagonal of 3.43 x 2.30 deg
LONGEST_SIDE_DEG = 4.13
# of the triangle that it prints, rad; the star numbers it prints are others
ANGLES = (2.27327, 0.634202, 0.234213)
FIRST_HIP, LAST_HIP = 99002, 99145
EXCEPTIONS = Path(__file__).with_name("paper_stars.csv")

# Component A of HIP 98753 is TYC 2682-3566-1, the brighter of a pair 1.9 arcsec apart that the catalogue merges. Its
# observed place and epoch are Tycho-2's; the proper motion (mas/yr, in right ascension times cos(dec)) is the pair's.
_A_RA_DEG, _A_DEC_DEG, _A_EPOCH = 300.87250833, 36.02515667, 1991.6
_A_PM_RA, _A_PM_DEC = -10.7, -4.3
# Errors of the place and of the motion, which belongs to the pair and not to A alone.
_A_SIGMA_MAS = np.hypot(4.0, 2.6 * (EPOCH - _A_EPOCH))


def sides(v1, v2):
    """Angular separation in rad of unit vectors (..., 3): in the form that keeps small ones exact."""
    apart = v1 - v2
    return 2 * np.arcsin(np.minimum(1.0, 0.5 * np.sqrt(np.einsum("...i,...i->...", apart, apart))))


def opposite_sides(v):
    """The sides (..., 3) in rad opposite the corners v (..., 3, 3) of spherical triangles."""
    return sides(v[..., [1, 0, 0], :], v[..., [2, 2, 1], :])


def angles(side):
    """The angles (..., 3) in rad of spherical triangles with sides (..., 3), each opposite its angle.

    Equation 4 by the half-angle formula, tan(A/2)^2 = sin(s-b) sin(s-c) / (sin s sin(s-a)): exact for small triangles.
    """
    s = side.sum(-1, keepdims=True) / 2
    rest = np.sin(np.maximum(s - side, 0.0))
    return 2 * np.arctan2(np.sqrt(rest[..., [1, 0, 0]] * rest[..., [2, 2, 1]]), np.sqrt(np.sin(s) * rest))


def plain_cut(catalogue):
    """Rows of all stars brighter than LIMIT_MAG with a HIP number, nearly the same as the paper's stars."""
    return np.flatnonzero((catalogue.vmag_centi < 100 * LIMIT_MAG) & (catalogue.hip > 0))


def stars(catalogue):
    """Rows of the paper's stars, from Tycho-2's main table; a merged pair comes twice if the paper has both stars.

    EXCEPTIONS holds the stars that the compact catalogue cannot distinguish; `tools/data/paper_stars.py` makes it from
    the original files.
    """
    *tyc, times = np.loadtxt(EXCEPTIONS, int, delimiter=",", skiprows=2, unpack=True)
    there = _number(catalogue.tyc.T.astype(int))
    order = np.argsort(there)
    place = np.searchsorted(there[order], _number(tyc)).clip(max=len(there) - 1)
    row = order[place]
    assert np.array_equal(there[row], _number(tyc))
    return np.concatenate([np.setdiff1d(plain_cut(catalogue), row), np.repeat(row, times)])


def _number(tyc):
    """A single number for each Tycho identifier (3, N)."""
    return (tyc[0] * 100_000 + tyc[1]) * 10 + tyc[2]


def count_triangles(v, longest_side_rad):
    """Number of triples of the unit vectors v (N, 3) that have all sides below longest_side_rad.

    Each pair is directed from the lower row to the higher one. So each triangle is counted once, as a path of two pairs
    whose ends are a pair too.
    """
    pairs = cKDTree(v).query_pairs(2 * np.sin(longest_side_rad / 2), output_type="ndarray")
    near = csr_array((np.ones(len(pairs), np.int64), (pairs[:, 0], pairs[:, 1])), (len(v), len(v)))
    return int(((near @ near) * near).sum())


def angles_of_printed(catalogue):
    """Angles (3,) in rad of the triangle whose angles the paper prints, and their sigma (3,).

    The sigma comes from the place of component A at J2000, known to 22 mas.
    """
    first, last = (
        catalogue.directions(np.flatnonzero(catalogue.hip == hip))[0] for hip in (FIRST_HIP, LAST_HIP)
    )
    ra, dec = np.radians([_A_RA_DEG, _A_DEC_DEG])
    years = EPOCH - _A_EPOCH
    ra, dec = ra + _A_PM_RA * MAS * years / np.cos(dec), dec + _A_PM_DEC * MAS * years

    def at(ra, dec):
        return angles(opposite_sides(np.stack([first, unit_vector(ra, dec), last])))

    here, step = at(ra, dec), _A_SIGMA_MAS * MAS
    return here, np.hypot(at(ra + step / np.cos(dec), dec) - here, at(ra, dec + step) - here)

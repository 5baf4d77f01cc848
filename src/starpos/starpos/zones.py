# SPDX-License-Identifier: Apache-2.0
"""Where on the sky the rows of a table lie: cells of one degree of declination by one of right ascension.

A table in declination zones, each sorted by right ascension, has every cell in one run of rows.
"""

from itertools import pairwise

import numpy as np

ZONES = 180  # of declination
CELLS = 360  # of right ascension in each


def cell_starts(zone_start: np.ndarray, ra_deg: np.ndarray) -> np.ndarray:
    """First row of every cell and the end (ZONES * CELLS + 1,) of a table whose zones start at zone_start (181,)."""
    edges = np.arange(CELLS)
    starts = [first + np.searchsorted(ra_deg[first:last], edges) for first, last in pairwise(zone_start)]
    return np.append(np.concatenate(starts), zone_start[-1]).astype(np.int32)


def rows_near(cell_start: np.ndarray, centre: np.ndarray, radius_rad: float) -> tuple[np.ndarray, np.ndarray]:
    """Rows in the cells that cones about the unit vectors centre (Q, 3) touch: (cone (M,), row (M,))."""
    x, y, z = centre.T
    flat = np.sqrt(x * x + y * y)
    ra, dec = np.degrees(np.arctan2(y, x)), np.arctan2(z, flat)
    reach = np.sin(radius_rad) / np.maximum(flat, 1e-12)
    pole_inside = np.abs(dec) + radius_rad > np.pi / 2 - 1e-9
    half = np.where(pole_inside, 180.0, np.degrees(np.arcsin(np.minimum(reach, 1.0))))
    low = np.maximum(np.degrees(dec - radius_rad) + 90, 0).astype(int)
    high = np.minimum(np.degrees(dec + radius_rad) + 90, ZONES - 1).astype(int)
    first = np.floor(ra - half).astype(int)
    width = np.minimum(np.floor(ra + half).astype(int) - first + 1, CELLS)
    cone, zone = ranges(low, high - low + 1)
    begin = (first % CELLS)[cone]
    beyond = begin + width[cone] - CELLS  # a run that passes 360 deg goes on at 0
    zone *= CELLS
    begins, ends = zone + begin, zone + np.minimum(beyond, 0) + CELLS
    if (wraps := beyond > 0).any():
        cone = np.concatenate([cone, cone[wraps]])
        begins = np.concatenate([begins, zone[wraps]])
        ends = np.concatenate([ends, (zone + beyond)[wraps]])
    start = cell_start[begins]
    run, rows = ranges(start, cell_start[ends] - start)
    return cone[run], rows


def ranges(first: np.ndarray, count: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The numbers first[i] .. first[i] + count[i] - 1 of all i in a row: (i (M,), number (M,))."""
    owner = np.repeat(np.arange(len(count)), count)
    before = np.cumsum(count) - count
    return owner, np.arange(len(owner)) + (first - before)[owner]

# SPDX-License-Identifier: Apache-2.0
"""Where on the sky the rows of a table lie: cells of one degree of declination by one of right ascension.

A table in declination zones, each sorted by right ascension, has every cell in one run of rows.
"""

import math
from itertools import pairwise

import numpy as np

ZONES = 180  # of declination
CELLS = 360  # of right ascension in each


def cell_starts(zone_start: np.ndarray, ra_deg: np.ndarray) -> np.ndarray:
    """First row of every cell and the end (ZONES * CELLS + 1,) of a table whose zones start at zone_start (181,)."""
    edges = np.arange(CELLS)
    starts = [first + np.searchsorted(ra_deg[first:last], edges) for first, last in pairwise(zone_start)]
    return np.append(np.concatenate(starts), zone_start[-1]).astype(np.int32)


def rows_near(cell_start: np.ndarray, centre: np.ndarray, radius_rad: float) -> np.ndarray:
    """Rows (M,) in the cells that a cone about centre (3,), of any length, touches."""
    x, y, z = centre.tolist()
    flat = math.hypot(x, y)
    ra, dec = math.degrees(math.atan2(y, x)), math.atan2(z, flat)
    half = 180.0  # of the cone in right ascension: all where a pole is inside
    if abs(dec) + radius_rad < math.pi / 2 - 1e-9:
        half = math.degrees(math.asin(min(math.sin(radius_rad) / math.cos(dec), 1.0)))
    low = max(int(math.degrees(dec - radius_rad) + 90), 0)
    high = min(int(math.degrees(dec + radius_rad) + 90), ZONES - 1)
    first = math.floor(ra - half)
    width = min(math.floor(ra + half) - first + 1, CELLS)
    first %= CELLS
    # in each zone, and where a run passes 360 deg once more from 0 on
    runs = [(first, min(first + width, CELLS))] + (
        [(0, first + width - CELLS)] if first + width > CELLS else []
    )
    runs = [
        (zone * CELLS + begin, zone * CELLS + end) for zone in range(low, high + 1) for begin, end in runs
    ]
    return np.concatenate([np.arange(cell_start[begin], cell_start[end]) for begin, end in runs])


def ranges(first: np.ndarray, count: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The numbers first[i] .. first[i] + count[i] - 1 of all i in a row: (i (M,), number (M,))."""
    owner = np.repeat(np.arange(len(count)), count)
    before = np.cumsum(count) - count
    return owner, np.arange(len(owner)) + (first - before)[owner]

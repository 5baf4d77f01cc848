# SPDX-License-Identifier: Apache-2.0
"""Find the rows of a table that lie in a part of the sky, by cells of 1 deg of declination and 1 deg of right ascension.

The table is in declination zones, each sorted by right ascension, so that the rows of a cell follow each other.
"""

import math
from itertools import pairwise

import numpy as np

# Zones of declination.
ZONES = 180
# Cells of right ascension in each zone.
CELLS = 360


def cell_starts(zone_start: np.ndarray, ra_deg: np.ndarray) -> np.ndarray:
    """First row of each cell, and the end (ZONES * CELLS + 1,); zone_start (181,) is the first row of each zone."""
    edges = np.arange(CELLS)
    starts = [first + np.searchsorted(ra_deg[first:last], edges) for first, last in pairwise(zone_start)]
    return np.append(np.concatenate(starts), zone_start[-1]).astype(np.int32)


def rows_near(cell_start: np.ndarray, centre: np.ndarray, radius_rad: float) -> np.ndarray:
    """Rows (M,) in all cells that a cone about the vector centre (3,), of any length, touches."""
    x, y, z = centre.tolist()
    flat = math.hypot(x, y)
    ra, dec = math.degrees(math.atan2(y, x)), math.atan2(z, flat)
    # half the cone's width in right ascension; if a pole is inside, it has all of it
    half = 180.0
    if abs(dec) + radius_rad < math.pi / 2 - 1e-9:
        half = math.degrees(math.asin(min(math.sin(radius_rad) / math.cos(dec), 1.0)))
    low = max(int(math.degrees(dec - radius_rad) + 90), 0)
    high = min(int(math.degrees(dec + radius_rad) + 90), ZONES - 1)
    first = math.floor(ra - half)
    width = min(math.floor(ra + half) - first + 1, CELLS)
    first %= CELLS
    # a run that passes 360 deg continues at 0
    runs = [(first, min(first + width, CELLS))] + (
        [(0, first + width - CELLS)] if first + width > CELLS else []
    )
    runs = [
        (zone * CELLS + begin, zone * CELLS + end) for zone in range(low, high + 1) for begin, end in runs
    ]
    return np.concatenate([np.arange(cell_start[begin], cell_start[end]) for begin, end in runs])


def ranges(first: np.ndarray, count: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The numbers first[i] .. first[i] + count[i] - 1 of all i, one after the other: arrays of i (M,) and number (M,)."""
    owner = np.repeat(np.arange(len(count)), count)
    before = np.cumsum(count) - count
    return owner, np.arange(len(owner)) + (first - before)[owner]

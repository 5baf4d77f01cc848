# SPDX-License-Identifier: Apache-2.0
"""The part of a frame that shows the sky, where whole sides of it are white: a lamp, a wall, a readout that broke off."""

import numpy as np

from starpos.frames.stars import Window

# A row or a column is white where this share of its pixels is.
WHITE = 0.9
# Number of pixels of a side that are looked at first.
FEW = 32


def window_of(plane: np.ndarray, highest: int, sky_dn: float) -> Window | None:
    """The Window of plane (h, w) between the white rows and columns along its sides; None if it has none, as is usual.

    White is the frame's largest value, highest. Rows and columns as dark as sky_dn may be a sky that is cut off at 0.
    """
    sides = plane[0], plane[-1], plane[:, 0], plane[:, -1]
    if highest <= sky_dn or not any(_is_white(side, highest) for side in sides):
        return None
    white = plane == highest
    columns = np.flatnonzero(white.mean(0) < WHITE)
    if len(columns) == 0:
        return None
    left, right = int(columns[0]), int(columns[-1]) + 1
    rows = np.flatnonzero(white[:, left:right].mean(1) < WHITE)
    if len(rows) == 0:
        return None
    window = left, int(rows[0]), right, int(rows[-1]) + 1
    return None if window == (0, 0, plane.shape[1], plane.shape[0]) else window


def _is_white(side: np.ndarray, highest: int) -> bool:
    """Whether most pixels (N,) along a side are white; a few of them, far apart, are enough to recognise a dark side."""
    few = side[:: len(side) // FEW + 1]
    if 2 * np.count_nonzero(few == highest) <= len(few):
        return False
    return bool(np.count_nonzero(side == highest) >= WHITE * len(side))

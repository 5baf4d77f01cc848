# SPDX-License-Identifier: Apache-2.0
"""The pixels around each star, all stars at once."""

from dataclasses import dataclass

import numpy as np

from starpos.detection.background import phase_of


@dataclass(frozen=True, eq=False)
class Stamps:
    """Squares of S x S px around N stars, S odd.

    x, y    (N,) int: the central pixel of each
    signal  (N, S, S) float32, DN above the background
    noise   (N, S, S) float32, DN rms of the background, as large as sums over neighbouring pixels show it
    good    (N, S, S) bool: on the frame and not saturated
    full    (N, S, S) bool: saturated
    phase   (N, S, S) int: which of the colour mosaic's 2 x 2 pixels, 0..3; 0 everywhere without a mosaic
    """

    x: np.ndarray
    y: np.ndarray
    signal: np.ndarray
    noise: np.ndarray
    good: np.ndarray
    full: np.ndarray
    phase: np.ndarray

    @property
    def reach(self) -> int:
        return self.signal.shape[1] // 2

    def take(self, index) -> "Stamps":
        return Stamps(*(getattr(self, name)[index] for name in self.__dataclass_fields__))

    def offsets(self, x, y):
        """Column and row of every pixel relative to the points x, y (N,): two float32 (N, S, S) broadcastables."""
        grid = np.arange(-self.reach, self.reach + 1)
        dx = (grid + (self.x - x)[:, None]).astype(np.float32)
        dy = (grid + (self.y - y)[:, None]).astype(np.float32)
        return dx[:, None, :], dy[:, :, None]


def cut(plane, background, x, y, reach, saturation) -> Stamps:
    """The Stamps of (2 reach + 1) px around the pixels x, y (N,) int of plane (h, w)."""
    height, width = plane.shape
    grid = np.arange(-reach, reach + 1)
    columns, rows = x[:, None] + grid, y[:, None] + grid
    on = ((rows >= 0) & (rows < height))[:, :, None] & ((columns >= 0) & (columns < width))[:, None, :]
    pixels = plane[np.clip(rows, 0, height - 1)[:, :, None], np.clip(columns, 0, width - 1)[:, None, :]]
    rows, columns = rows[:, :, None], columns[:, None, :]
    level, noise = background.of_pixels(x, y, rows, columns)
    phase = phase_of(rows, columns) if background.is_mosaic else np.zeros(pixels.shape, np.int8)
    full = on & (pixels >= saturation)
    return Stamps(x, y, pixels - level, noise, on & ~full, full, phase)

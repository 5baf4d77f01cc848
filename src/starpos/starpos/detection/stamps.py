# SPDX-License-Identifier: Apache-2.0
"""The pixels around each star, all stars at once."""

from dataclasses import dataclass, fields

import numpy as np

from starpos.detection._beside import dots, lonely, rims
from starpos.detection._stamps import around, light_around
from starpos.detection.background import Background
from starpos.normal import SIGMA_PER_MAD

# Around a star the sky counts as brighter or less even than the mesh says where about 50 pixels lie so far above it, or
# scatter so much, in units of a pixel's noise: both are four times their errors.
RAISED, UNEVEN = 0.6, 1.6
# Maximum light of the 24 pixels around a hot pixel, as a share of its light and in sigma of their noise.
ALONE, NOTHING = 0.25, 3.0
# Hot pixels may be neighbours: of nine pixels all but the brightest, or all but the two brightest, then hold less than
# these shares of the brightest's light. In a star of 1 px FWHM they hold 0.7 even where two share the light.
HALF, QUARTER = 0.5, 0.25


@dataclass(frozen=True, eq=False, kw_only=True)
class Stamps:
    """Squares of S x S px around N stars, S odd.

    x, y    (N,) int: the central pixel of each
    signal  (N, S, S) float32, DN above the background
    noise   (N, S, S) float32, DN rms of the background, including the correlation of neighbouring pixels
    good    (N, S, S) bool: on the frame and not saturated
    full    (N, S, S) bool: saturated
    phase   (N, S, S) uint8: number 0..3 in the colour mosaic's 2 x 2 pattern; 0 everywhere without a mosaic
    """

    x: np.ndarray
    y: np.ndarray
    signal: np.ndarray
    noise: np.ndarray
    good: np.ndarray
    full: np.ndarray
    phase: np.ndarray

    @property
    def size(self) -> int:
        """Pixels along a side, S."""
        return self.signal.shape[1]

    @property
    def reach(self) -> int:
        """Pixels from the centre to the edge, (S - 1) / 2."""
        return self.signal.shape[1] // 2

    def take(self, index: np.ndarray | slice) -> "Stamps":
        """The stamps that index selects; a mask (N,) that selects all copies nothing."""
        if isinstance(index, np.ndarray) and index.dtype == bool and index.all():
            return self
        return Stamps(**{name: getattr(self, name)[index] for name in COLUMNS})

    def corner(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Offsets (N,) px of the first column and row from the points x, y (N,) px."""
        return self.x - self.reach - x, self.y - self.reach - y


COLUMNS = tuple(f.name for f in fields(Stamps))


def cut(
    plane: np.ndarray, background: Background, x: np.ndarray, y: np.ndarray, reach: int, saturation: float
) -> Stamps:
    """The Stamps of (2 reach + 1) px around the pixels x, y (N,) int of plane (h, w)."""
    x, y = (np.ascontiguousarray(v, np.intp) for v in (x, y))
    signal, noise, good, full, phase = around(plane, x, y, reach, *background.near(x, y), saturation)
    grid = np.arange(-reach, reach + 1)
    for streak in background.streaks:
        more, least = streak.at((y[:, None] + grid)[:, :, None], (x[:, None] + grid)[:, None, :])
        signal, noise = (signal - more).astype(np.float32), np.maximum(noise, least).astype(np.float32)
    return Stamps(x=x, y=y, signal=signal, noise=noise, good=good, full=full, phase=phase)


def lights(
    plane: np.ndarray, background: Background, x: np.ndarray, y: np.ndarray, reach: int, saturation: float
) -> tuple[np.ndarray, np.ndarray]:
    """The signal (N, S, S) of the Stamps that `cut` makes, and whether one of their pixels is saturated, (N,) bool."""
    x, y = (np.ascontiguousarray(v, np.intp) for v in (x, y))
    signal, full = light_around(plane, x, y, reach, background.near(x, y)[0], saturation)
    grid = np.arange(-reach, reach + 1)
    for streak in background.streaks:
        more, _ = streak.at((y[:, None] + grid)[:, :, None], (x[:, None] + grid)[:, None, :])
        signal = (signal - more).astype(np.float32)
    return signal, full


def are_dots(plane: np.ndarray, background: Background, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Whether the pixels x, y (N,) int are hot, one or two together: the others of nine have hardly any light.

    Less than half the brightest's without it, or less than a quarter of it without the second too.
    """
    x, y = (np.ascontiguousarray(v, np.intp) for v in (x, y))
    level, _ = background.near(x, y)
    # a streak is wider than nine pixels
    for streak in background.streaks:
        level = level + streak.at(y, x)[0][:, None].astype(np.float32)
    return dots(plane, x, y, level, HALF, QUARTER)


def are_alone(plane: np.ndarray, background: Background, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Whether the pixels x, y (N,) int are certainly hot: almost no light in the 24 pixels around them, or of streaks."""
    x, y = (np.ascontiguousarray(v, np.intp) for v in (x, y))
    return lonely(plane, x, y, *background.near(x, y), 2, ALONE, NOTHING)


def surroundings(
    plane: np.ndarray, background: Background, x: np.ndarray, y: np.ndarray, reach: int
) -> tuple[np.ndarray, np.ndarray]:
    """The sky's level and scatter on the edges of squares, reach px from the pixels x, y (N,) int, over the noise.

    0 and 1 where a difference may be chance. Near a roof, among twigs or under a cloud the sky is brighter and less
    even than the background's mesh says.
    """
    x, y = (np.ascontiguousarray(v, np.intp) for v in (x, y))
    return rims(plane, x, y, *background.near(x, y), reach, SIGMA_PER_MAD, RAISED, UNEVEN)

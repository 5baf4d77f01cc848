# SPDX-License-Identifier: Apache-2.0
"""The pixels around each star, all stars at once, and their Gaussian-windowed moments."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from starpos.detection._moments import centroids, clip_widths
from starpos.detection._pixels import cut_stamps, measure_rims, sum_squares
from starpos.detection.background import SkyPlane
from starpos.units import SIGMA_PER_MAD

# Around a star the sky counts as brighter or less even than the mesh says where about 50 pixels lie so far above it, or
# scatter so much, in units of a pixel's noise: both are four times their errors.
RAISED, UNEVEN = 0.6, 1.6
# Maximum light of the 24 pixels around a hot pixel, as a share of its light and in sigma of their noise.
ALONE, NOTHING = 0.25, 3.0
# Hot pixels may be neighbours: of nine pixels all but the brightest, or all but the two brightest, then hold less than
# these shares of the brightest's light. In a star of 1 px FWHM they hold 0.7 even where two share the light.
HALF, QUARTER = 0.5, 0.25


Each = TypeVar("Each", bound="StarRows")


@dataclass(frozen=True, eq=False, kw_only=True)
class StarRows:
    """A dataclass of arrays that have a row for each of N stars."""

    def select(self: Each, index: np.ndarray | slice) -> Each:
        """The rows that index selects; a mask (N,) that selects all copies nothing."""
        if isinstance(index, np.ndarray) and index.dtype == bool and index.all():
            return self
        return replace(self, **{name: column[index] for name, column in vars(self).items()})


def joined(parts: Sequence[Each]) -> Each:
    """The rows of several objects of one class, one after the other."""
    if len(parts) == 1:
        return parts[0]
    rows = {name: np.concatenate([getattr(part, name) for part in parts]) for name in vars(parts[0])}
    return replace(parts[0], **rows)


@dataclass(frozen=True, eq=False, kw_only=True)
class Stamps(StarRows):
    """Squares of S x S px around N stars, S odd.

    x, y    (N,) int: the central pixel of each
    signal  (N, S, S) float32, DN above the background
    noise   (N, S, S) float32, DN rms of the background, including the correlation of neighbouring pixels
    good    (N, S, S) bool: on the frame and not saturated
    full    (N, S, S) bool: saturated
    phase   (N, S, S) uint8: number 0..3 in the colour mosaic's 2 x 2 pattern; 0 everywhere without a mosaic
    spike   (N, S, S) bool: much brighter than its neighbours, as in no star; the signal has their mean instead
    """

    x: np.ndarray
    y: np.ndarray
    signal: np.ndarray
    noise: np.ndarray
    good: np.ndarray
    full: np.ndarray
    phase: np.ndarray
    spike: np.ndarray

    @property
    def size(self) -> int:
        """Pixels along a side, S."""
        return self.signal.shape[1]

    @property
    def reach(self) -> int:
        """Pixels from the centre to the edge, (S - 1) / 2."""
        return self.signal.shape[1] // 2

    def corner(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Offsets (N,) px of the first column and row from the points x, y (N,) px."""
        return self.x - self.reach - x, self.y - self.reach - y


def cut(sky: SkyPlane, x: np.ndarray, y: np.ndarray, reach: int) -> Stamps:
    """The Stamps of (2 reach + 1) px around the pixels x, y (N,) int."""
    x, y = (np.ascontiguousarray(v, np.intp) for v in (x, y))
    signal, noise, good, full, phase = cut_stamps(sky.plane, x, y, reach, *sky.near(x, y), sky.saturation)
    grid = np.arange(-reach, reach + 1)
    for streak in sky.streaks:
        more, least = streak.at((y[:, None] + grid)[:, :, None], (x[:, None] + grid)[:, None, :])
        signal, noise = (signal - more).astype(np.float32), np.maximum(noise, least).astype(np.float32)
    spike = np.zeros(good.shape, bool)
    return Stamps(x=x, y=y, signal=signal, noise=noise, good=good, full=full, phase=phase, spike=spike)


def are_dots(sky: SkyPlane, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Whether the pixels x, y (N,) int are hot, one or two together: the others of nine have hardly any light.

    Less than half the brightest's without it, or less than a quarter of it without the second too.
    """
    x, y = (np.ascontiguousarray(v, np.intp) for v in (x, y))
    level, noise = sky.near(x, y)
    # a streak is wider than nine pixels
    for streak in sky.streaks:
        level = level + streak.at(y, x)[0][:, None].astype(np.float32)
    total, first, second, _ = sum_squares(sky.plane, x, y, level, noise, 1)
    return (total - first < HALF * first) | (total - first - second < QUARTER * first)


def are_alone(sky: SkyPlane, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Whether the pixels x, y (N,) int are certainly hot: almost no light in the 24 pixels around them, or of streaks."""
    x, y = (np.ascontiguousarray(v, np.intp) for v in (x, y))
    total, first, _, sigma = sum_squares(sky.plane, x, y, *sky.near(x, y), 2)
    return total - first < np.minimum(ALONE * first, NOTHING * sigma)


def surroundings(sky: SkyPlane, x: np.ndarray, y: np.ndarray, reach: int) -> tuple[np.ndarray, np.ndarray]:
    """The sky's level and scatter on the edges of squares, reach px from the pixels x, y (N,) int, over the noise.

    0 and 1 where a difference may be chance. Near a roof, among twigs or under a cloud the sky is brighter and less
    even than its mesh says.
    """
    x, y = (np.ascontiguousarray(v, np.intp) for v in (x, y))
    return measure_rims(sky.plane, x, y, *sky.near(x, y), reach, SIGMA_PER_MAD, RAISED, UNEVEN)


# px2. A single pixel has 1/12, and a star's light never falls on one pixel only.
NARROWEST = 0.2
# px2. Through a narrower window a sum over pixels is too far from the integral.
NARROWEST_WINDOW = 1.2
# Maximum distance of a centroid from the peak, px, and the number of rounds.
FARTHEST, ROUNDS = 2.0, 3


def window_for(shape: np.ndarray) -> np.ndarray:
    """The windows (N, 2, 2) px2 for stars of covariance shape: the same, unless too narrow for sums over pixels."""
    return clip_widths(shape, NARROWEST_WINDOW, np.inf, 1.0)


def centroid(signal: np.ndarray, x: np.ndarray, y: np.ndarray, shape: np.ndarray) -> np.ndarray:
    """Windowed centroids x, y (2, N) px of stars of covariance shape (N or 1, 2, 2) px2, near the peaks.

    signal (N, S, S): of stamps around the pixels x, y (N,) int.
    """
    return centroids(signal, x, y, shape, NARROWEST_WINDOW, ROUNDS, FARTHEST)

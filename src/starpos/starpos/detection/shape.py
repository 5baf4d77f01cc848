# SPDX-License-Identifier: Apache-2.0
"""Gaussian-windowed moments: place and width of a star with any symmetric image, without a model of it.

If a star is a Gaussian of covariance C, its moments through an elliptical Gaussian window of covariance W equal the
moments of a Gaussian of covariance V = (C^-1 + W^-1)^-1 (Bernstein & Jarvis 2002, AJ 123, 583).
"""

import numpy as np

from starpos.detection._moments import centred, settled, windowed
from starpos.detection._shapes import before, clipped, inverted, relative, through

# px2. A single pixel has 1/12, and a star's light never falls on one pixel only.
NARROWEST = 0.2
# px2. Through a narrower window a sum over pixels is too far from the integral.
NARROWEST_WINDOW = 1.2
# A star counts for the typical shape if its mean is so near the peak, px, and its windowed image wider than that, px2;
# which is settled at a relative change of so little.
NEAR, THINNEST, SETTLED = 1.5, 0.1, 1e-3
# px. A centroid is not farther from the peak.
FARTHEST = 2.0


def at_least(shape: np.ndarray, floor: float) -> np.ndarray:
    """The covariance shape (..., 2, 2) px2 with no principal axis below floor px2."""
    return clipped(_each(shape), floor, np.inf, 1.0).reshape(shape.shape)


def _each(shape: np.ndarray) -> np.ndarray:
    """Covariances (..., 2, 2) in one row (N, 2, 2)."""
    return shape.reshape(-1, 2, 2)


def moments(
    signal: np.ndarray, left: np.ndarray, top: np.ndarray, window: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Moments of stamps' signals (N, S, S) through a window (2, 2) px2, or one window each (N, 2, 2), about points.

    left, top (N,) px: first column and row of a stamp, from the point.

    Returns the sum (N,), the mean offset (N, 2) px from the points and the covariance (N, 2, 2) px2 of the windowed
    image; NaN where there is no light. Pixels off the frame and saturated ones count as they are: without them the
    centroid would be biased away from the edge.
    """
    return windowed(signal, left, top, _each(window))


def centroid(
    signal: np.ndarray, x: np.ndarray, y: np.ndarray, shape: np.ndarray, rounds: int = 3
) -> tuple[np.ndarray, np.ndarray]:
    """Windowed centroids x, y (N,) px of stars of covariance shape px2, near the peaks.

    signal (N, S, S): of stamps around the pixels x, y (N,) int.
    """
    window = window_for(shape)
    # through the window an offset looks smaller than it is
    gain = np.eye(2) + shape @ inverted(_each(window)).reshape(window.shape)
    return centred(signal, x, y, _each(window), _each(gain), rounds, FARTHEST)


def window_for(shape: np.ndarray) -> np.ndarray:
    """The window (..., 2, 2) px2 for stars of covariance shape: the same, unless too narrow for sums over pixels."""
    return at_least(shape, NARROWEST_WINDOW)


def frame_shape(signal: np.ndarray, blur: float = 0.0, rounds: int = 12) -> np.ndarray | None:
    """The typical covariance C (2, 2) px2 of stars, signals (N, S, S), measured through a window of the same shape.

    blur, px2, is what smoothing added to their covariance. None if no star can be measured.
    """
    # a wide window suits all stars, but in the noise of a wide window faint sharp ones are lost
    reach = signal.shape[1] // 2
    for width in (max(1.5, reach / 4), 1.5):
        # a stamp does not hold a wider star than half its reach
        shape = settled(
            signal, width**2, NARROWEST_WINDOW, NARROWEST, (reach / 2) ** 2, rounds, NEAR, THINNEST, SETTLED
        )  # fmt: skip
        if shape is not None:
            return at_least(shape - blur * np.eye(2), NARROWEST)
    return None


def own_shape(seen: np.ndarray, window: np.ndarray) -> np.ndarray:
    """Covariances (N, 2, 2) px2 of stars from the windowed images' covariances seen (N, 2, 2); NaN where impossible."""
    return before(seen, _each(window))


def relative_widths(seen: np.ndarray, shape: np.ndarray, window: np.ndarray) -> np.ndarray:
    """The smaller and the larger squared width (N, 2) of windowed images, over the widths of `shape` (..., 2, 2).

    Both are 1 for a star of that shape and near 0 for a hot pixel. Along a streak the larger reaches 2 if the window is
    the shape. NaN counts as 0.
    """
    return relative(seen, through(_each(shape), _each(window)))

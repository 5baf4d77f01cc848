# SPDX-License-Identifier: Apache-2.0
"""The pixels around each star, all stars at once."""

from dataclasses import dataclass, fields

import numpy as np

from starpos.detection.background import phase_of

RAISED = 0.6  # of a pixel's noise, and
UNEVEN = (
    1.6  # times it: what about 50 pixels must show, four times the errors, to count for more than the mesh
)

# of a hot pixel's light, and of their noise: what the 24 pixels around it have less of, together
ALONE, NOTHING = 0.25, 3.0


@dataclass(frozen=True, eq=False, kw_only=True)
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
        return Stamps(**{f.name: getattr(self, f.name)[index] for f in fields(self)})

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
    return Stamps(x=x, y=y, signal=pixels - level, noise=noise, good=on & ~full, full=full, phase=phase)


def are_dots(plane, background, x, y):
    """Whether the pixels x, y (N,) int are hot: less light in their neighbours together than in half of the brightest."""
    core = cut(plane, background, x, y, 1, np.inf).signal.reshape(-1, 9)
    peak = core.max(1)
    return core.sum(1) - peak < 0.5 * peak


def are_alone(plane, background, x, y):
    """Whether the pixels x, y (N,) int are hot beyond doubt: next to no light around them, no star beside them either."""
    around = cut(plane, background, x, y, 2, np.inf)
    peak = around.signal.max((1, 2))
    beside = around.signal.sum((1, 2)) - peak
    return beside < np.minimum(ALONE * peak, NOTHING * np.sqrt((around.noise**2).sum((1, 2))))


def surroundings(plane, background, x, y, reach):
    """What `uneven` says of the squares reach px around the pixels x, y (N,) int."""
    side, end = np.arange(-reach, reach), np.full(2 * reach, reach)
    columns = np.clip(x[:, None] + np.concatenate([side, end, -side, -end]), 0, plane.shape[1] - 1)
    rows = np.clip(y[:, None] + np.concatenate([-end, side, end, -side]), 0, plane.shape[0] - 1)
    level, noise = background.of_pixels(x, y, rows, columns)
    return uneven(plane[rows, columns] - level, noise)


def uneven(signal, noise):
    """How far (N,) the pixels (N, K) around stars lie above 0, and how much more they scatter than their noise.

    Both in units of the noise; 0 and 1 where it may be chance. Beside a roof, among twigs or under a cloud the sky is
    brighter and less even than the mesh knows.
    """
    score = signal / noise
    level = np.median(score, axis=1)
    scatter = 1.4826 * np.median(np.abs(score - level[:, None]), axis=1)
    return np.where(level > RAISED, level, 0), np.where(scatter > UNEVEN, scatter, 1)

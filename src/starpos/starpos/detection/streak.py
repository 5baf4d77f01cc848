# SPDX-License-Identifier: Apache-2.0
"""Satellite trails across a frame: treated as sky with its own level and noise, not as a row of stars."""

from dataclasses import dataclass

import cv2
import numpy as np
from scipy import ndimage

from starpos.detection._neighbours import groups, near_pairs
from starpos.detection.background import Background

# px. Peaks along a trail are never farther apart.
CELL = 8
# Minimum number of peaks of a line,
FEWEST = 12
# and its minimum length, px.
SHORTEST = 100
# Cells along a line without any peak, at most.
GAP = 2
# px. A wider band is not a trail.
HALF_WIDTH = 12
# px along a trail over which its light is taken as constant.
BLOCK = 64
# Over a pixel's sigma: five times the error of a block's median.
SIGNIFICANT = 5 * 1.25 / BLOCK**0.5


@dataclass(frozen=True, eq=False)
class Streak:
    """A straight band of light from point (2,) px along the unit vector direction (2,), both (x, y).

    length        px from the point to the streak's other end
    level, noise  (blocks, 2 HALF_WIDTH + 1) DN above the sky and DN rms, in equal blocks along the band and at whole px
                  across it; 0 where the streak has no light
    """

    point: np.ndarray
    direction: np.ndarray
    length: float
    level: np.ndarray
    noise: np.ndarray

    def at(self, rows: np.ndarray, columns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Level and noise (DN) of the streak at pixels; 0 off it."""
        along, across = self._place(rows, columns)
        block = np.clip(along / self.length * len(self.level), 0, len(self.level) - 1).astype(int)
        offset = np.rint(across).astype(int) + HALF_WIDTH
        on = np.abs(along / self.length - 0.5) <= 0.5 + 2 * HALF_WIDTH / self.length
        on &= (offset >= 0) & (offset <= 2 * HALF_WIDTH)
        offset = np.where(on, offset, 0)
        return on * self.level[block, offset], on * self.noise[block, offset]

    def _place(self, rows: np.ndarray, columns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Distances of pixels along and across the streak, px."""
        dx, dy = columns - self.point[0], rows - self.point[1]
        along_x, along_y = self.direction
        return dx * along_x + dy * along_y, dy * along_x - dx * along_y


def find_streaks(
    plane: np.ndarray, background: Background, x: np.ndarray, y: np.ndarray
) -> tuple[Streak, ...]:
    """The Streaks on which peaks x, y (N,) int px lie. A row of stars without light between them is not a streak."""
    if len(x) < FEWEST:
        return ()
    found: list[Streak] = []
    if not _may_be_a_line(x, y):
        return ()
    grid = np.zeros((background.height // CELL + 1, background.width // CELL + 1), np.uint8)
    grid[y // CELL, x // CELL] = 255
    lines = cv2.HoughLinesP(grid, 1, np.pi / 360, FEWEST, minLineLength=SHORTEST / CELL, maxLineGap=GAP)
    points, free = np.stack([x, y], 1).astype(float), np.ones(len(x), bool)
    for ends in [] if lines is None else lines.reshape(-1, 2, 2)[:50] * CELL + CELL / 2:
        line = _through(points[free], ends)
        if line is None:
            continue
        streak = _measured(plane, background, *line)
        if streak is not None:
            found.append(streak)
            free &= streak.at(y, x)[0] == 0
    return tuple(found)


def _may_be_a_line(x: np.ndarray, y: np.ndarray) -> bool:
    """Whether enough peaks x, y (N,) int px are joined by gaps that a line may have."""
    pairs = near_pairs(x.astype(float), y.astype(float), np.sqrt(2) * (GAP + 2) * CELL)
    return len(pairs) > 0 and bool(np.bincount(groups(pairs, len(x))).max() >= FEWEST)


def _through(points: np.ndarray, ends: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """Point and unit direction of the line through those points (N, 2) that lie near the segment with these ends (2, 2).

    None if too few points lie there.
    """
    point, direction = ends[0], ends[1] - ends[0]
    length = np.hypot(*direction)
    direction = direction / length
    for reach in (1.5 * CELL, 0.5 * CELL, 3):
        along, across = (points - point) @ direction, (points - point) @ [-direction[1], direction[0]]
        near = (np.abs(across) < reach) & (along > -CELL) & (along < length + CELL)
        if near.sum() < FEWEST:
            return None
        dx, dy, px, py = (
            cv2.fitLine(points[near].astype(np.float32), cv2.DIST_HUBER, 0, 0.01, 0.01).ravel().astype(float)
        )
        along = (ends - [px, py]) @ [dx, dy]
        point, direction = np.array([px, py]) + along.min() * np.array([dx, dy]), np.array([dx, dy])
        length = np.ptp(along)
    return point, direction


def _measured(
    plane: np.ndarray, background: Background, point: np.ndarray, direction: np.ndarray
) -> Streak | None:
    """The Streak along a line from edge to edge of the frame, or None if there is no light along it."""
    size = np.array([background.width, background.height])
    slope = np.where(np.abs(direction) < 1e-9, 1e-9, direction)
    walls = np.stack([-point / slope, (size - 1 - point) / slope])
    first, last = walls.min(0).max(), walls.max(0).min()
    if last - first < SHORTEST:
        return None
    blocks = round((last - first) / BLOCK)
    start = point + first * direction
    along = np.linspace(0, last - first, blocks * BLOCK).reshape(blocks, 1, BLOCK)
    across = np.arange(-HALF_WIDTH, HALF_WIDTH + 1)[:, None]
    column = np.rint(start[0] + along * direction[0] - across * direction[1]).astype(int)
    row = np.rint(start[1] + along * direction[1] + across * direction[0]).astype(int)
    centre = column[:, HALF_WIDTH, BLOCK // 2], row[:, HALF_WIDTH, BLOCK // 2]
    row, column = np.clip(row, 0, size[1] - 1), np.clip(column, 0, size[0] - 1)
    level, noise = background.of_pixels(*centre, row, column)
    signal, sigma = plane[row, column] - level, np.median(noise, axis=-1)
    middle = np.median(signal, axis=-1)
    # residuals of neighbouring pixels along the streak are correlated, so the noise is measured on sums of three
    rest = signal - middle[..., None]
    rest = (rest[..., :-2] + rest[..., 1:-1] + rest[..., 2:]) / 3**0.5
    scatter, most = np.quantile(np.abs(rest), (0.9, 0.97), axis=-1)
    lit = middle > SIGNIFICANT * sigma
    on = lit[:, HALF_WIDTH - 2 : HALF_WIDTH + 3].any(1) & ~lit[:, 0] & ~lit[:, -1]
    if on.sum() * BLOCK < SHORTEST:
        return None
    # one more pixel on each side, because the edges lie between pixels; the end blocks may be filled only in part
    lit, whole = on[:, None] & lit, ndimage.binary_erosion(on)[:, None]
    level = middle * ndimage.binary_dilation(lit, np.ones((1, 3)))
    noise = np.where(whole, scatter / 1.645, most) * ndimage.binary_dilation(lit, np.ones((3, 3)))
    return Streak(start, direction, last - first, level, noise)

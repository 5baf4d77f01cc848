# SPDX-License-Identifier: Apache-2.0
"""Satellites' trails across a frame: a part of the sky with a level and a noise of its own, not a row of stars."""

from dataclasses import dataclass

import cv2
import numpy as np
from scipy import ndimage

CELL = 8  # px: peaks along a trail are never further apart
FEWEST = 12  # peaks that make a line
SHORTEST = 100  # px
HALF_WIDTH = 12  # px: a wider band is no trail
BLOCK = 64  # px along a trail over which it is taken as even
SIGNIFICANT = 5 * 1.25 / BLOCK**0.5  # of a pixel's sigma: five times the error of a block's median


@dataclass(frozen=True, eq=False)
class Streak:
    """A straight band through point (2,) px along the unit vector direction (2,), both (x, y).

    length        px from the point to the streak's other end
    level, noise  (blocks, 2 HALF_WIDTH + 1) DN above the sky and DN rms, at whole offsets across the band, in equal
                  blocks along it; 0 where there is no light of it
    """

    point: np.ndarray
    direction: np.ndarray
    length: float
    level: np.ndarray
    noise: np.ndarray

    def at(self, rows, columns):
        """level and noise (DN) the streak has at pixels; 0 off it."""
        along, across = self._place(rows, columns)
        block = np.clip(along / self.length * len(self.level), 0, len(self.level) - 1).astype(int)
        offset = np.rint(across).astype(int) + HALF_WIDTH
        on = np.abs(along / self.length - 0.5) <= 0.5 + 2 * HALF_WIDTH / self.length
        on &= (offset >= 0) & (offset <= 2 * HALF_WIDTH)
        offset = np.where(on, offset, 0)
        return on * self.level[block, offset], on * self.noise[block, offset]

    def _place(self, rows, columns):
        dx, dy = columns - self.point[0], rows - self.point[1]
        return dx * self.direction[0] + dy * self.direction[1], dy * self.direction[0] - dx * self.direction[
            1
        ]


def find_streaks(plane, background, x, y):
    """The Streaks (a tuple) on which peaks x, y (N,) int lie; what merely looks like a row of stars is none."""
    if len(x) < FEWEST:
        return ()
    found = []
    grid = np.zeros((background.height // CELL + 1, background.width // CELL + 1), np.uint8)
    grid[y // CELL, x // CELL] = 255
    lines = cv2.HoughLinesP(grid, 1, np.pi / 360, FEWEST, minLineLength=SHORTEST / CELL, maxLineGap=2)
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


def _through(points, ends):
    """A point and a unit direction of the line through the points (N, 2) near the segment ends (2, 2)."""
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


def _measured(plane, background, point, direction):
    """The Streak along a line from edge to edge of the frame, None where there is none."""
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
    # what is left of it is not independent from pixel to pixel along it: the noise of sums of three tells
    rest = signal - middle[..., None]
    rest = (rest[..., :-2] + rest[..., 1:-1] + rest[..., 2:]) / 3**0.5
    scatter, most = np.quantile(np.abs(rest), (0.9, 0.97), axis=-1)
    lit = middle > SIGNIFICANT * sigma
    on = lit[:, HALF_WIDTH - 2 : HALF_WIDTH + 3].any(1) & ~lit[:, 0] & ~lit[:, -1]
    if on.sum() * BLOCK < SHORTEST:
        return None
    # its edges lie between the offsets; at its ends it may fill a part of a block
    lit, whole = on[:, None] & lit, ndimage.binary_erosion(on)[:, None]
    level = middle * ndimage.binary_dilation(lit, np.ones((1, 3)))
    noise = np.where(whole, scatter / 1.645, most) * ndimage.binary_dilation(lit, np.ones((3, 3)))
    return Streak(start, direction, last - first, level, noise)

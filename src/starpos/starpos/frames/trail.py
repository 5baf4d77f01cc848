# SPDX-License-Identifier: Apache-2.0
"""How the stars of a frame move during its exposure, where it is known: by a gyro, or by the frame's maker."""

import math
from dataclasses import dataclass

import numpy as np

from starpos.errors import FrameError
from starpos.frames.exposure import LARGEST_SIDE_PX


@dataclass(frozen=True, kw_only=True)
class Trail:
    """The way of stars from the beginning of an exposure to its end; FrameError for impossible values.

    middle_px  (x, y) px of a star in the middle of the frame
    roll_rad   by which all stars turn about the middle, from x towards y; a camera that looks up rolls when its vehicle
               turns
    """

    middle_px: tuple[float, float]
    roll_rad: float = 0.0

    def __post_init__(self) -> None:
        if not (np.hypot(*self.middle_px) < LARGEST_SIDE_PX and abs(self.roll_rad) < np.pi):
            raise FrameError(
                f"the trail is {self.middle_px} px with a roll of {self.roll_rad} rad; give finite numbers, a roll "
                "of less than half a turn, or None where it is unknown."
            )

    @property
    def _chord(self) -> float:
        """Way of a star by the roll, over its distance from the middle."""
        return 2 * math.sin(self.roll_rad / 2)

    def at(self, x: np.ndarray, y: np.ndarray, width: int, height: int) -> np.ndarray:
        """The ways (N, 2) px of stars that are at x, y (N,) px at mid-exposure, on a frame of that size."""
        across = np.stack([(height - 1) / 2 - y, x - (width - 1) / 2], -1)
        return np.array(self.middle_px) + self._chord * across

    def mean_square(self, width: int, height: int) -> np.ndarray:
        """The mean (2, 2) px2 of the products of a way's components, over a frame."""
        return np.outer(self.middle_px, self.middle_px) + self._chord**2 * np.diag([height**2, width**2]) / 12

    def varies_px(self, width: int, height: int) -> float:
        """Px by which the way in a corner of a frame differs from the way in the middle."""
        return abs(self._chord) * math.hypot(width, height) / 2

    def halved(self) -> "Trail":
        """The trail on a frame reduced by two."""
        x, y = self.middle_px
        return Trail(middle_px=(x / 2, y / 2), roll_rad=self.roll_rad)

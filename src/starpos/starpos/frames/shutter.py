# SPDX-License-Identifier: Apache-2.0
"""A camera's shutter: when each row of a frame was exposed.

A rolling shutter begins and ends the exposure of each row a little later than the row before. A driver and DATE-OBS give
the time of the row that is read first: a stamp is the middle of this row's exposure. While the rows follow, the sky
turns by 15 arcsec a second. So the field looks sheared and turned, and in a field of few degrees this becomes a large
turn.
"""

from dataclasses import dataclass

import numpy as np

from starpos.errors import FrameError

# 1 sigma of an unstated readout: evenly up to 50 ms, from the top or from the bottom
UNKNOWN_READOUT_S = 0.03
MAX_READOUT_S = 10.0
# 1 sigma of the time from a consumer camera's stamp to the opening of its shutter: evenly up to 100 ms
UNKNOWN_LATENCY_S = 0.06


@dataclass(frozen=True)
class Shutter:
    """Times of a frame's rows; FrameError for impossible values.

    readout_s         from the row that is read first to the last, s: positive where the top row is first, negative
                      where it is the bottom row; 0 where all rows are exposed at once (a global shutter), or where it is
                      unknown which is first
    readout_stddev_s  its standard deviation
    """

    readout_s: float = 0.0
    readout_stddev_s: float = UNKNOWN_READOUT_S

    def __post_init__(self) -> None:
        if not (abs(self.readout_s) <= MAX_READOUT_S and 0 <= self.readout_stddev_s <= MAX_READOUT_S):
            raise FrameError(
                f"a shutter's readout of {self.readout_s:g} s +- {self.readout_stddev_s:g} s is impossible: "
                f"give at most "
                f"{MAX_READOUT_S:g} s from the first row to the last, negative where the bottom row is first, and its "
                "standard deviation"
            )

    def later_s(self, y: np.ndarray, height: int) -> np.ndarray:
        """Time (N,) in s from the stamp to the middle of the exposure of the rows y (N,) px of a frame of that height."""
        return abs(self.readout_s) * self._share(y, height)

    def errors_s(self, y: np.ndarray, height: int) -> np.ndarray:
        """Change (N, 2) of `later_s` for two independent errors of 1 sigma, which all frames share."""
        # from an unknown end: the difference from row to row has either sign, and their mean is late by half the readout
        middle = 0.0 if self.readout_s else 0.5
        errors = np.empty((len(y), 2))
        errors[:, 0], errors[:, 1] = self._share(y, height) - middle, middle
        return self.readout_stddev_s * errors

    def _share(self, y: np.ndarray, height: int) -> np.ndarray:
        """Share (N,) of the readout that is over when the rows y (N,) are read."""
        down = np.asarray(y, float) / max(height - 1, 1)
        return 1 - down if self.readout_s < 0 else down


GLOBAL = Shutter(0.0, 0.0)
UNKNOWN = Shutter()

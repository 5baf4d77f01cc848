# SPDX-License-Identifier: Apache-2.0
"""The noise that the latest tilts show, by how far each differs from the one before it."""

import numpy as np

from starpos.instrument.inclinometer import Tilt
from starpos.instrument.tilt_log import NEIGHBOURS_S, noise_excess

# Number of samples from which the noise is measured.
CAPACITY = 2000


class TiltSteps:
    """Differences of neighbouring samples, in order of time: the newest CAPACITY of them."""

    def __init__(self) -> None:
        self._number = self._axes = 0
        # time of the later sample, stated variance, difference of up to three axes; twice as long as what is kept
        self._rows = np.empty((2 * CAPACITY, 5))

    def clear(self) -> None:
        self._number = 0

    def note(self, before: Tilt, sample: Tilt) -> None:
        """Take two successive samples, if they are neighbours in time."""
        apart_s = sample.utc_unix_s - before.utc_unix_s
        # a repeated sample adds nothing, and counting it would distort the noise
        if self._number and sample.utc_unix_s <= self._rows[self._number - 1, 0]:
            return
        if not 0 < apart_s < NEIGHBOURS_S or sample.axes != before.axes:
            return
        # of another number of axes they are of another sensor
        if sample.axes != self._axes:
            self._axes, self._number = sample.axes, 0
        if self._number == len(self._rows):
            self._rows[:CAPACITY] = self._rows[CAPACITY:]
            self._number = CAPACITY
        row = self._rows[self._number]
        row[0], row[1] = sample.utc_unix_s, np.diag(sample.covariance).mean()
        row[2 : 2 + self._axes] = sample.theta - before.theta
        self._number += 1

    def forget_after(self, unix_s: float) -> None:
        """Drop the steps to samples of later times."""
        self._number = int(np.searchsorted(self._rows[: self._number, 0], unix_s, side="right"))

    def excess(self, end_unix_s: float) -> float:
        """Measured noise over the stated one, 1 or more, by samples up to a time."""
        rows = self._rows[max(self._number - CAPACITY, 0) : self._number]
        rows = rows[: np.searchsorted(rows[:, 0], end_unix_s, side="right")]
        if not len(rows):
            return 1.0
        return noise_excess(rows[:, 2 : 2 + self._axes], float(np.sqrt(rows[:, 1].mean())))

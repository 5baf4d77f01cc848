# SPDX-License-Identifier: Apache-2.0
"""The noise of samples, from the samples themselves."""

import math
from collections import deque

import numpy as np

from starpos.instrument.tilt_log import ENOUGH_NEIGHBOURS, SIGNIFICANT, white_noise

BLOCK_S = 0.1  # a sensor of 18 Hz remembers 9 ms: means over this are independent
APART_S = 3.0  # blocks further apart than this tell of drift rather than noise
LONG, SHORT = 200, 30  # differences of blocks: the estimate, and what notices that the noise has grown


class NoiseTracker:
    """The white noise, 1 sigma of one sample of each axis, as which averages of samples scatter.

    Neighbouring samples of a sensor with a bandwidth are alike, so it takes means over BLOCK_S, what they differ by from
    one to the next, and the noise of one sample that a mean of so many independent ones would show.
    """

    def __init__(self):
        self._differences: deque[tuple[float, float]] = deque(maxlen=LONG)
        self.restart()

    def restart(self):
        """What comes is of another kind: another rate."""
        self.sigma: tuple[float, float] | None = None  # None: too few samples yet
        self._differences.clear()
        self.interrupt()

    def interrupt(self):
        """What comes does not go on from what came."""
        self._before: tuple[float, int, float, float] | None = None  # begin, samples, means
        self._block: list[float] | None = None  # begin, samples, sums

    def add(self, time_s: float, x: float, y: float):
        """A sample at `time_s` of a clock that does not step."""
        block = self._block
        if block is not None and time_s - block[0] < 0.95 * BLOCK_S:  # samples each 0.1 s are a block each
            block[1] += 1
            block[2] += x
            block[3] += y
            return
        if block is not None:
            self._close(block)
        self._block = [time_s, 1, x, y]

    def _close(self, block: list[float]):
        begin, n, x, y = block
        mean = (begin, n, x / n, y / n)
        before, self._before = self._before, mean
        if before is None or not 0 < begin - before[0] <= APART_S:
            return
        scale = math.sqrt(2 / (1 / n + 1 / before[1]))
        self._differences.append((scale * (mean[2] - before[2]), scale * (mean[3] - before[3])))
        if len(self._differences) >= ENOUGH_NEIGHBOURS:
            self.sigma = self._estimate()

    def _estimate(self) -> tuple[float, float]:
        differences = np.array(self._differences)
        long, short = white_noise(differences), white_noise(differences[-SHORT:])
        grown = short > long * (1 + SIGNIFICANT / math.sqrt(SHORT))
        x, y = np.where(grown, short, long).tolist()
        return x, y


def noise_text(sigma: tuple[float, float] | None) -> str:
    """1 sigma rad of both axes, in arcsec."""
    if sigma is None:
        return "not known yet"
    return ", ".join(f"{math.degrees(s) * 3600:.2f}" for s in sigma)

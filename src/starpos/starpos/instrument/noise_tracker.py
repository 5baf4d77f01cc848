# SPDX-License-Identifier: Apache-2.0
"""Noise of the samples, estimated from the samples themselves."""

import math
from collections import deque

import numpy as np

from starpos.instrument.tilt_log import MIN_NEIGHBOURS, SIGNIFICANT, white_noise

# A sensor of 18 Hz has a memory of 9 ms, so means over this time are independent.
BLOCK_S = 0.1
# Blocks further apart than this differ by drift rather than by noise.
APART_S = 3.0
# Numbers of block differences: the long run gives the estimate, the short one notices that the noise has grown.
LONG, SHORT = 200, 30


class NoiseTracker:
    """Estimates the white noise of each axis: `sigma` in rad for one sample, as averages of samples show it.

    Neighbouring samples of a sensor with a limited bandwidth are correlated. So it takes the means over BLOCK_S and the
    differences of successive means, and scales them to the noise of one sample as if samples were independent.
    """

    def __init__(self) -> None:
        self._differences: deque[list[float]] = deque(maxlen=LONG)
        self.restart()

    def restart(self) -> None:
        """Start again, because the samples are of another kind now, such as another rate."""
        # None: too few samples yet.
        self.sigma: tuple[float, ...] | None = None
        self._differences.clear()
        self.interrupt()

    def interrupt(self) -> None:
        """Begin a new block, because the next sample does not continue the last one."""
        # Begin, number of samples, means.
        self._before: list[float] | None = None
        # Begin, number of samples, sums.
        self._block: list[float] | None = None

    def add(self, time_s: float, *angles: float) -> None:
        """Take a sample (rad, of two axes or three) at `time_s` of a clock that does not step."""
        block = self._block
        # With the factor, samples that come every 0.1 s are one block each.
        if block is not None and time_s - block[0] < 0.95 * BLOCK_S:
            block[1:] = [block[1] + 1, *(s + angle for s, angle in zip(block[2:], angles, strict=True))]
            return
        if block is not None:
            self._close(block)
        self._block = [time_s, 1, *angles]

    def _close(self, block: list[float]) -> None:
        begin, n, *sums = block
        mean = [begin, n, *(s / n for s in sums)]
        before, self._before = self._before, mean
        if before is None or not 0 < begin - before[0] <= APART_S:
            return
        scale = math.sqrt(2 / (1 / n + 1 / before[1]))
        self._differences.append([scale * (a - b) for a, b in zip(mean[2:], before[2:], strict=True)])
        if len(self._differences) >= MIN_NEIGHBOURS:
            self.sigma = self._estimate()

    def _estimate(self) -> tuple[float, ...]:
        differences = np.array(self._differences)
        long, short = white_noise(differences), white_noise(differences[-SHORT:])
        grown = short > long * (1 + SIGNIFICANT / math.sqrt(SHORT))
        return tuple(np.where(grown, short, long).tolist())


def noise_text(sigma: tuple[float, ...] | None) -> str:
    """Write the noise of the axes (1 sigma, rad) in arcsec."""
    if sigma is None:
        return "not known yet"
    return ", ".join(f"{math.degrees(s) * 3600:.2f}" for s in sigma)

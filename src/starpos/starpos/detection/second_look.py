# SPDX-License-Identifier: Apache-2.0
"""A second look at a frame, at places where stars should be that are too faint to be detected."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import ndimage, special

from starpos.detection._peaks import smoothed
from starpos.detection.finding import SHARP, Kernel
from starpos.detection.plane import plane_of
from starpos.frames.frame import Frame
from starpos.frames.stars import Stars, Window
from starpos.normal import SIGMA_PER_MAD

FWHM_PER_SIGMA = 2.3548
# Radius of a kernel in sigma, and maximum sigma of stars that are looked for.
CUT, WIDEST_SIGMA = 2.5, 4.0
# The places around one, beyond its own light, at steps of some px; minimum number of them on the frame.
NEAREST, FARTHEST, STEP, FEWEST = 8, 60, 2, 200


@dataclass(frozen=True, eq=False)
class SecondLook:
    """What a frame shows at any place, against the places around it; nothing is computed before it is asked for.

    window   the part of the frame that shows something; None: all of it
    fwhm_px  width of its stars; None: unknown
    """

    frame: Frame
    window: Window | None
    fwhm_px: float | None

    @classmethod
    def of(cls, frame: Frame, stars: Stars) -> "SecondLook":
        """The second look at a frame whose stars were detected."""
        return cls(frame, stars.window, stars.fwhm_px)

    @cached_property
    def _kernel(self) -> Kernel:
        sigma = min(max(SHARP.sigma, (self.fwhm_px or 0.0) / FWHM_PER_SIGMA), WIDEST_SIGMA)
        return Kernel(sigma, int(np.ceil(CUT * sigma)), SHARP.flat)

    @cached_property
    def _smooth(self) -> np.ndarray:
        plane, _ = plane_of(self.frame)
        return smoothed(plane, self._kernel.weight, np.arange(len(plane)), 1)

    def __call__(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """How bright the places x, y (N,) px are: in sigma of a normal distribution, by rank; and the SNR.

        A place without a star has an even rank among the places around it, for any noise, so the first number never
        exceeds a normal distribution's. Ties count against a star. NaN at the frame's edge.
        """
        steps = np.arange(-FARTHEST, FARTHEST + 1, STEP)
        across, down = (d.ravel() for d in np.meshgrid(steps, steps))
        around = (np.hypot(across, down) >= NEAREST) & (np.hypot(across, down) <= FARTHEST)
        dx, dy = np.append(0, across[around]), np.append(0, down[around])
        height, width = self._smooth.shape
        left, top, right, bottom = self.window or (0, 0, width, height)
        edge = self._kernel.reach + 1
        sigmas, snr = np.full(len(x), np.nan), np.full(len(x), np.nan)
        for k in range(len(x)):
            column, row = x[k] + dx, y[k] + dy
            inside = (column >= left + edge) & (column < right - edge)
            inside &= (row >= top + edge) & (row < bottom - edge)
            if not inside[0] or np.count_nonzero(inside) < FEWEST:
                continue
            value = ndimage.map_coordinates(self._smooth, [row[inside], column[inside]], order=1)
            here, others = value[0], value[1:]
            middle = np.median(others)
            spread = SIGMA_PER_MAD * np.median(np.abs(others - middle))
            snr[k] = (here - middle) / spread if spread > 0 else 0.0
            sigmas[k] = -special.ndtri((1 + np.count_nonzero(others >= here)) / (1 + len(others)))
        return sigmas, snr

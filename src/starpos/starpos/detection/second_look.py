# SPDX-License-Identifier: Apache-2.0
"""Further looks at a frame whose first detection identifies nothing: its negative, other scales, expected places."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
from scipy import ndimage, special

from starpos.detection._peaks import smooth_rows
from starpos.detection.background import halved, plane_of
from starpos.detection.finding import SHARP, Kernel
from starpos.detection.pipeline import Detection, DetectionSettings, detect, enlarged
from starpos.frames.frame import Frame, Stars, Window
from starpos.units import SIGMA_PER_MAD

# Fewer stars identify no frame, so nothing is lost where its negative is looked at instead.
MIN_STARS = 4


def negative_of(frame: Frame) -> Frame:
    """The frame with dark and bright exchanged: its brightest value becomes 0."""
    return replace(frame, pixels=frame.pixels.max() - frame.pixels)


def detect_dark_too(frame: Frame) -> Detection:
    """The Detection of a frame, or of its negative where only that shows stars (`Stars.negative`)."""
    found = detect(frame)
    if len(found.stars) >= MIN_STARS or frame.pixels.size == 0:
        return found
    dark = detect(negative_of(frame))
    if len(dark.stars) < MIN_STARS:
        return found
    return replace(dark, stars=replace(dark.stars, negative=True, disc=found.stars.disc))


# (how often the frame is reduced by two, whether what is wider than a star is taken away), in the order of their use
VIEWS = (0, True), (1, True), (2, False)
# Maximum width (px) of a star's light.
WIDEST_PX = 9
# Cells of the background (px): what is left of clouds ends sooner than a sky.
MESH_PX = 16
# Minimum length (px) of a reduced frame's shorter side.
SHORTEST_PX = 64
# A flattened plane is stretched to at most this, by whole numbers: DN of 8 bits are coarse.
HIGHEST, MAX_STRETCH = 40_000, 32


def other_views(frame: Frame, window: Window | None) -> Iterator[Stars]:
    """Yield the stars of a frame as it is seen in each of the VIEWS that it is large enough for.

    window: the part of the frame that shows something, as `Stars` has it.
    """
    plane, mosaic = plane_of(frame)
    for halvings, flat in VIEWS:
        reduced = plane
        for _ in range(halvings):
            reduced = halved(reduced)[0]
        if min(reduced.shape) < SHORTEST_PX:
            continue
        if flat:
            reduced = _flattened(reduced if halvings or not mosaic else cv2.GaussianBlur(reduced, (3, 3), 0))
        reduced_frame = replace(frame, pixels=reduced, pattern="")
        settings = DetectionSettings(mesh_px=MESH_PX) if flat else DetectionSettings()
        yield enlarged(detect(reduced_frame, settings).stars, 2**halvings, frame.width, frame.height, window)


def _flattened(plane: np.ndarray) -> np.ndarray:
    """The plane (h, w), uint16, without what is wider than WIDEST_PX, stretched."""
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (WIDEST_PX, WIDEST_PX))
    rest = cv2.morphologyEx(plane, cv2.MORPH_TOPHAT, disc).astype(np.uint16)
    return rest * np.uint16(max(1, min(MAX_STRETCH, HIGHEST // max(1, int(rest.max())))))


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

    @cached_property
    def _kernel(self) -> Kernel:
        sigma = min(max(SHARP.sigma, (self.fwhm_px or 0.0) / FWHM_PER_SIGMA), WIDEST_SIGMA)
        return Kernel(sigma, int(np.ceil(CUT * sigma)), SHARP.flat)

    @cached_property
    def _smooth(self) -> np.ndarray:
        plane, _ = plane_of(self.frame)
        return smooth_rows(plane, self._kernel.weight, np.arange(len(plane)), 1)

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

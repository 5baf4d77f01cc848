# SPDX-License-Identifier: Apache-2.0
"""Other ways to see a frame whose stars, as they are detected first, identify nothing.

Nebulae, lit clouds and twigs teach a wrong PSF and raise the noise that stars stand out of: without what is wider than a
star, little of them is left. Stars much wider than the kernels that find peaks, on a frame whose noise makes sharp peaks,
are seen where the frame is reduced.
"""

from collections.abc import Iterator
from dataclasses import replace

import cv2
import numpy as np

from starpos.detection.pipeline import DetectionSettings, detect
from starpos.detection.plane import halved, plane_of
from starpos.frames.frame import Frame
from starpos.frames.stars import Stars

# (how often the frame is reduced by two, whether what is wider than a star is taken away), in the order of their use
WAYS = (0, True), (1, True), (2, False)
# Maximum width (px) of a star's light.
WIDEST_PX = 9
# Cells of the background (px): what is left of clouds ends sooner than a sky.
MESH_PX = 16
# Minimum length (px) of a reduced frame's shorter side.
SHORTEST_PX = 64
# A flattened plane is stretched to at most this, by whole numbers: DN of 8 bits are coarse.
HIGHEST, MAX_STRETCH = 40_000, 32


def otherwise(frame: Frame, window: tuple[int, int, int, int] | None) -> Iterator[Stars]:
    """Yield the stars of a frame as it is seen in each of the WAYS that it is large enough for.

    window: the part of the frame that shows something, as `Stars` has it.
    """
    plane, mosaic = plane_of(frame)
    for halvings, flat in WAYS:
        reduced = plane
        for _ in range(halvings):
            reduced = halved(reduced)[0]
        if min(reduced.shape) < SHORTEST_PX:
            continue
        if flat:
            reduced = _flattened(reduced if halvings or not mosaic else cv2.GaussianBlur(reduced, (3, 3), 0))
        seen = replace(frame, pixels=reduced, pattern="", trail=None)
        settings = DetectionSettings(mesh_px=MESH_PX) if flat else DetectionSettings()
        yield _enlarged(detect(seen, settings).stars, 2**halvings, frame, window)


def _flattened(plane: np.ndarray) -> np.ndarray:
    """The plane (h, w), uint16, without what is wider than WIDEST_PX, stretched."""
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (WIDEST_PX, WIDEST_PX))
    rest = cv2.morphologyEx(plane, cv2.MORPH_TOPHAT, disc).astype(np.uint16)
    return rest * np.uint16(max(1, min(MAX_STRETCH, HIGHEST // max(1, int(rest.max())))))


def _enlarged(stars: Stars, times: int, frame: Frame, window: tuple[int, int, int, int] | None) -> Stars:
    """The stars of a reduced frame, on the original frame."""
    return replace(
        stars,
        x=times * stars.x + (times - 1) / 2,
        y=times * stars.y + (times - 1) / 2,
        covariance=times**2 * stars.covariance,
        fwhm_px=None if stars.fwhm_px is None else times * stars.fwhm_px,
        width=frame.width,
        height=frame.height,
        window=window,
    )

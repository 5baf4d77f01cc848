# SPDX-License-Identifier: Apache-2.0
"""Negatives, as photographic plates are scanned: dark stars on a bright sky."""

from dataclasses import replace

from starpos.detection.pipeline import Detection, detect
from starpos.frames.frame import Frame

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
    return replace(dark, stars=replace(dark.stars, negative=True))

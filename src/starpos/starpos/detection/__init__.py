# SPDX-License-Identifier: Apache-2.0
"""Frames to stars: find them, then measure each at the physical limit.

background -> finding -> learn (shape, psf) -> fit -> pipeline, which decides what is a star.
"""

from starpos.detection.pipeline import Detection, DetectionSettings, detect

__all__ = ["Detection", "DetectionSettings", "detect"]

# SPDX-License-Identifier: Apache-2.0
"""Why a frame was not identified, in a sentence: likely causes from its stars, its field and the catalogue."""

import numpy as np

from starpos.frames.stars import SATURATED, Stars
from starpos.identification import MIN_STARS
from starpos.instrument.camera import Camera
from starpos.sky import deeper
from starpos.sky.catalogue import Catalogue

# Images wider than this (FWHM, px) are out of focus, or the frame has more pixels than its lens resolves.
WIDE_PX = 8.0
# If this share of the brightest detections is saturated, their order of brightness may be wrong.
BRIGHTEST, MANY = 20, 0.5


def why_unidentified(stars: Stars, camera: Camera, catalogue: Catalogue) -> str:
    """The sentence for a frame of which no part of the sky was found."""
    n = len(stars)
    wide = stars.fwhm_px is not None and stars.fwhm_px > WIDE_PX
    saturated = (stars.flags & SATURATED) != 0
    if n < MIN_STARS:
        hint = f" ({int(saturated.sum())} saturated)" if saturated.any() else ""
        found = f"{n} stars detected{hint}"
        focus = (
            f"they are {stars.fwhm_px:.0f} px wide (FWHM): focus"
            if wide
            else "check clouds, focus and exposure"
        )
        return f"{stars.place}: {found}, at least {MIN_STARS} are needed: {focus}"
    causes = []
    if thin := deeper.too_thin(catalogue, camera):
        causes.append(thin)
    if wide:
        causes.append(f"its stars are {stars.fwhm_px:.0f} px wide (FWHM): focus, or bin the pixels")
    if np.mean(saturated[:BRIGHTEST]) >= MANY:
        causes.append(
            f"{int(saturated[:BRIGHTEST].sum())} of its {min(n, BRIGHTEST)} brightest are saturated, so that their order "
            "of brightness says little: expose for a shorter time"
        )
    causes.append(f"check the focal length ({camera.fx:.0f} px given, 3 % is allowed), clouds and exposure")
    return f"{stars.place}: no part of the sky matches its {n} stars: {'; '.join(causes)}"

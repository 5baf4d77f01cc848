# SPDX-License-Identifier: Apache-2.0
"""Frames whose detections are noise: nearly all are equally bright, which stars never are.

Stars become more numerous by a factor of about 2.8 with each magnitude. So of 150 the brightest hundredth are tens of
times as bright as the median, and 5 times even where a picture is stretched by a gamma of 2.2. Peaks of noise end soon
above the threshold that found them, however many there are. So do the bumps of a JPEG whose sky is cut off at black.
"""

import numpy as np

from starpos.frames.stars import Stars

# Number of detections that show the distribution of their brightness.
MIN_DETECTIONS = 150
# If the brightest hundredth is less than this many times as bright as the median, all are noise.
MIN_RANGE, BRIGHTEST = 3.5, 0.01


def why_noise(stars: Stars) -> str:
    """A sentence that says why the detections on a frame are noise; '' if they may be stars, and for a list of stars."""
    # only a detector says how wide images are; the flux of a list may be anything that sorts it
    if stars.fwhm_px is None or len(stars) < MIN_DETECTIONS:
        return ""
    brightest = float(stars.flux[int(BRIGHTEST * len(stars))] / np.median(stars.flux))
    if brightest >= MIN_RANGE:
        return ""
    return (
        f"{stars.place}: its {len(stars)} detections are noise, because nearly all are equally bright (the brightest "
        f"hundredth {brightest:.1f} times the median): check exposure and lens cap, and save pictures without compression"
    )

# SPDX-License-Identifier: Apache-2.0
"""Find which of many poses are worth a fit, by the frame's bright stars that coincide with bright catalogue stars."""

import numpy as np

from starpos.identification.pose import FrameStars, Poses
from starpos.identification.sky import Sky

# A star lies within so many sigma of its place.
MATCH_SIGMA = 3.5
# Logarithm of the share of detections that may be false.
LOG_FALSE = np.log(0.35)
# Log-odds.
WORTH_A_FIT = 4.0
# So many of the brightest catalogue stars on the frame are looked at.
MOST_STARS = 440


def promising(
    field: FrameStars, sky: Sky, poses: Poses, star: np.ndarray, radius_px: np.ndarray
) -> list[int]:
    """Rows of those of the K poses that are worth a fit, best first.

    star       (K, 3): the field's stars from which each pose was made
    radius_px  (K, n): how far from their places the n = min(N, field.tested) brightest stars may be
    """
    worth = sky.brightest.worth(
        field.compiled,
        poses.attitude,
        poses.focal_px,
        poses.mirrored,
        star,
        radius_px,
        sky.years,
        sky.velocity,
        MOST_STARS,
        MATCH_SIGMA,
        LOG_FALSE,
    )
    return [k for k in np.argsort(-worth, kind="stable").tolist() if worth[k] > WORTH_A_FIT]

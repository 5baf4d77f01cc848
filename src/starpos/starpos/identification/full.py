# SPDX-License-Identifier: Apache-2.0
"""Verify a pose by a frame's stars, and match all detections with all catalogue stars of the field."""

from dataclasses import dataclass

import numpy as np

from starpos.identification._found import Identification
from starpos.identification._frame import FrameStars
from starpos.identification._poses import Rules
from starpos.identification._search import Judge
from starpos.identification.evidence import CHANCES, Prior
from starpos.identification.pose import SMALL_STEP, STEPS, Pose
from starpos.identification.sky import Sky
from starpos.normal import SIGMA_PER_MAD

# Minimum number of stars of an identification.
MIN_STARS = 4
# Minimum log-odds of an identification: one try identifies at most one in 1e9 frames of random points. With all further
# tries it is 1.2 in 1e9 (second_look.py), and up to 14 more where other focal lengths are tried (fix/other_focal.py).
MIN_LOG_ODDS = np.log(1e9)
ROUNDS = 3
# A star may be GATE_SIGMA of the spread from its place, plus GATE_PX; the spread is at least MIN_SPREAD_PX.
MIN_SPREAD_PX, GATE_SIGMA, GATE_PX = 0.02, 4.0, 0.2
# Number of the brightest detections that take part.
FAINTEST_FIT = 2000
# Errors of catalogue and lens, which a centroid's own error does not include.
FLOOR_PX = 0.05
# With a larger spread of residuals the lens is distorted: all stars get the same weight, or the brightest few decide.
BENT_PX = 0.3
# Closer stars make one image.
BLEND_PX = 2.5
# Number of catalogue stars that are compared with a frame: per detection, and in addition.
PER_DETECTION, MORE_STARS = 3, 50
# Distance beyond the frame at which a star still counts as on it, and from its edge within which it may be cut (px).
EDGE_PX, INSIDE_PX = 2.0, 5.0


RULES = Rules(
    rounds=ROUNDS,
    fewest_stars=MIN_STARS,
    steps=STEPS,
    small_step=SMALL_STEP,
    floor_px=FLOOR_PX,
    sigma_per_mad=SIGMA_PER_MAD,
    least_spread_px=MIN_SPREAD_PX,
    gate_sigma=GATE_SIGMA,
    gate_px=GATE_PX,
    edge_px=EDGE_PX,
    inside_px=INSIDE_PX,
    blend_px=BLEND_PX,
    per_detection=PER_DETECTION,
    more_stars=MORE_STARS,
    most_stars=FAINTEST_FIT,
    bent_px=BENT_PX,
)


@dataclass(frozen=True)
class OnFrame:
    """S catalogue stars on a frame, brightest first.

    index       (S,): rows of the star catalogue
    directions  (S, 3)
    blend_px    (S,): how far fainter stars that make one image with them may move it
    """

    index: np.ndarray
    directions: np.ndarray
    blend_px: np.ndarray

    @classmethod
    def of(cls, field: FrameStars, sky: Sky, pose: Pose, most_detections: int) -> "OnFrame":
        """The stars that the field's brightest detections may be, at most `most_detections` of them."""
        found = sky.stars.on_frame(
            field,
            pose.mirrored,
            pose.attitude,
            pose.focal_px,
            sky.years,
            sky.velocity,
            EDGE_PX,
            PER_DETECTION * min(len(field), most_detections) + MORE_STARS,
            BLEND_PX,
        )
        return cls(*found)


def judge(field: FrameStars, sky: Sky, prior: Prior, enough: float = MIN_LOG_ODDS) -> Judge:
    """What judges poses of a frame by a prior, for compiled code; enough: log-odds of an identification."""
    return Judge(
        field,
        sky.stars,
        sky.years,
        sky.velocity,
        prior,
        enough,
        RULES,
        CHANCES,
    )


def verify_pose(
    field: FrameStars,
    sky: Sky,
    near_pose: Pose,
    radius_px: np.ndarray,
    prior: Prior,
    enough: float = MIN_LOG_ODDS,
) -> Identification | None:
    """Identify a frame's stars, starting from those within radius_px (N,) of their places by a pose near the right one.

    None unless the evidence is beyond doubt: log-odds of `enough`.
    """
    judged = judge(field, sky, prior, enough)
    return judged.identified(near_pose.attitude, near_pose.focal_px, near_pose.mirrored, radius_px)

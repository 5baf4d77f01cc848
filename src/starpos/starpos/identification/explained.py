# SPDX-License-Identifier: Apache-2.0
"""How much of a frame an identification explains: its bright detections, and the bright stars that should be there."""

from dataclasses import dataclass

import numpy as np

from starpos.identification.full import Identification, OnFrame
from starpos.identification.pose import TEST_STARS, FrameStars, Pose
from starpos.identification.sky import Sky

# At least so many catalogue stars are asked for, where the frame has as many.
LEAST_DUE = 8
# An identification explains a frame if it explains this share of its bright detections, or if this share of the bright
# stars that should be there are: then the other detections are false stars.
ENOUGH_EXPLAINED, ENOUGH_SEEN = 0.5, 0.6
# A star so near the frame's edge (px) may be cut off.
MARGIN_PX = 5.0


@dataclass(frozen=True)
class Explained:
    """Counts of what an identification explains.

    explained, bright  of so many brightest detections, those that are catalogue stars
    seen, due          of so many brightest catalogue stars on the frame, those that are detected
    """

    explained: int
    bright: int
    seen: int
    due: int

    @property
    def enough(self) -> bool:
        """Whether the frame is explained."""
        return self.explained >= ENOUGH_EXPLAINED * self.bright or self.seen >= ENOUGH_SEEN * self.due


def explained_by(found: Identification, field: FrameStars, sky: Sky) -> Explained:
    """How much of a frame's stars an identification explains.

    As many of the brightest catalogue stars are due as bright detections are explained: where these are the brightest
    stars of the sky, nearly all are seen, however faint the frame goes; where they are chance, few are.
    """
    bright = min(len(field), TEST_STARS)
    explained = int(np.count_nonzero(found.star < bright))
    pose = Pose(found.attitude, field.focal_px * found.focal_scale, found.mirrored)
    stars = OnFrame.of(field, sky, pose, TEST_STARS)
    inside = np.abs(pose.project(stars.directions) - field.middle) < field.half - MARGIN_PX
    due = stars.index[inside.all(1)][: max(explained, LEAST_DUE)]
    return Explained(explained, bright, int(np.isin(due, found.catalogue).sum()), len(due))

# SPDX-License-Identifier: Apache-2.0
"""How much of a frame an identification explains: its bright detections, and the bright stars that should be there."""

from dataclasses import dataclass

from starpos.frozen import at_once
from starpos.identification._frame import FrameStars
from starpos.identification.full import Identification
from starpos.identification.pose import TEST_STARS

# Minimum number of catalogue stars looked for, if the frame has as many.
MIN_DUE = 8
# Minimum share of the bright detections that are identified, and of the bright stars due that are seen. One of the two is
# enough: if most stars due are seen, the other detections are false stars.
MIN_EXPLAINED, MIN_SEEN = 0.5, 0.6


@at_once
@dataclass(frozen=True)
class Explained:
    """Counts of what an identification explains.

    explained, bright  catalogue stars among the brightest detections, and the number of these detections
    seen, due          detections among the brightest catalogue stars on the frame, and the number of these stars
    """

    explained: int
    bright: int
    seen: int
    due: int

    @property
    def enough(self) -> bool:
        """Whether the frame is explained."""
        return self.explained >= MIN_EXPLAINED * self.bright or self.seen >= MIN_SEEN * self.due


def explained_by(found: Identification, field: FrameStars) -> Explained:
    """How much of a frame's stars an identification explains.

    As many of the brightest catalogue stars are due as bright detections are explained: where these are the brightest
    stars of the sky, nearly all are seen, however faint the frame goes; where they are chance, few are.
    """
    bright = min(len(field), TEST_STARS)
    number, seen, due = found.explains(bright, MIN_DUE)
    return Explained(number, bright, seen, due)

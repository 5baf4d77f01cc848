# SPDX-License-Identifier: Apache-2.0
"""Which catalogue star is which: from a prior, or lost in space from a frame's brightest stars.

Triangles of the brightest stars are looked up by their shape; candidates that share a side support each other (the
paper's search); the pose of each is fitted to the brightest stars that agree and weighed by its evidence, so that a match
is accepted by its probability and never by a count, and then carried to the faintest stars seen.
"""

from starpos.identification.full import Identification
from starpos.identification.prior import PlumbPrior, PointingPrior
from starpos.identification.search import FEWEST_STARS, identify, identify_directions
from starpos.identification.sky import Sky

__all__ = [
    "FEWEST_STARS",
    "Identification",
    "PlumbPrior",
    "PointingPrior",
    "Sky",
    "identify",
    "identify_directions",
]

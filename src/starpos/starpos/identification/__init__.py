# SPDX-License-Identifier: Apache-2.0
"""Identify a frame's stars with catalogue stars: from a prior, or lost in space from the brightest stars.

Triangles of the brightest stars are looked up by their shape. Candidates that share a side support each other (the
paper's search). The pose of each is fitted to the brightest stars that agree, and its evidence is computed: a match is
accepted by its probability, never by a number of stars. Then the fainter stars are matched too.
"""

from starpos.identification.evidence import Identification
from starpos.identification.prior import PlumbPrior, PointingPrior
from starpos.identification.search import MIN_STARS, field_of, identify
from starpos.identification.sky import Sky

__all__ = ["MIN_STARS", "Identification", "PlumbPrior", "PointingPrior", "Sky", "field_of", "identify"]

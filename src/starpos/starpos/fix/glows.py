# SPDX-License-Identifier: Apache-2.0
"""Glows one after another: a lamp stands still in a camera at rest while the Sun moves on, which alone proves it."""

import math
from collections import deque
from dataclasses import dataclass

import numpy as np

from starpos.frozen import at_once
from starpos.rotation import angle

# Minimum way of the Sun, and maximum way of a glow that stands still, in sigma of two glows; minimum share of the Sun's
# way by which a glow moves.
MOVED_SIGMAS, STILL_SIGMAS, STILL = 8.0, 4.0, 0.5
# Minimum interval (s) between the glows that later ones are compared with, and their maximum number.
APART_S, KEPT = 60.0, 60


@at_once
@dataclass(frozen=True)
class Glow:
    """A saturated spot on a frame, which may be the Sun, and where the Sun stood then.

    ray (3,): its direction in C.  itrs (3,): the Sun's.  sigma (rad): of ray, along an axis.
    """

    utc_unix_s: float
    ray: np.ndarray
    itrs: np.ndarray
    sigma: float

    def stood_still(self, later: "Glow") -> bool | None:
        """Whether the spot has kept its place in the camera while the Sun moved; None while either is too little."""
        went, moved = angle(self.itrs, later.itrs), angle(self.ray, later.ray)
        sigma = math.hypot(self.sigma, later.sigma)
        if went < MOVED_SIGMAS * sigma or STILL_SIGMAS * sigma < moved < STILL * went:
            return None
        return bool(moved < STILL * went)


class Glows:
    """The glows of one camera, of which those that stand still are no Sun."""

    def __init__(self) -> None:
        self._kept: deque[Glow] = deque(maxlen=KEPT)

    def before(self, glow: Glow) -> tuple[bool | None, float]:
        """Take the next glow; whether it has stood still while the Sun moved on, and since when (Unix s).

        None where no glow before it shows that.
        """
        found = [(still, g.utc_unix_s) for g in self._kept if (still := g.stood_still(glow)) is not None]
        if not self._kept or abs(glow.utc_unix_s - self._kept[-1].utc_unix_s) >= APART_S:
            self._kept.append(glow)
        return next((one for one in found if one[0]), found[0] if found else (None, math.nan))

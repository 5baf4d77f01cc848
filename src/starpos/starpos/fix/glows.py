# SPDX-License-Identifier: Apache-2.0
"""Glows one after another: a lamp stands still in a camera at rest while the Sun moves on."""

import math
from collections import deque
from dataclasses import dataclass

import numpy as np

from starpos import rotation
from starpos.frozen import at_once

# The Sun has moved on from this many sigma of two glows; what has moved by less than the second number stands still. No share
# of the Sun's way: over hours that is half the frame, and a camera that is turned may have the Sun again in any place of it.
MOVED_SIGMAS, STILL_SIGMAS = 8.0, 4.0
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
        """Whether the spot has kept its place in the camera while the Sun moved; None as long as that is too little."""
        went, moved = _angle(self.itrs, later.itrs), _angle(self.ray, later.ray)
        sigma = math.hypot(self.sigma, later.sigma)
        return None if went < MOVED_SIGMAS * sigma else moved < STILL_SIGMAS * sigma


def _angle(a: np.ndarray, b: np.ndarray) -> float:
    return math.atan2(float(np.linalg.norm(rotation.cross(a, b))), float(a @ b))


class Glows:
    """The glows of one camera, of which those that stand still are no Sun."""

    def __init__(self) -> None:
        self._kept: deque[Glow] = deque(maxlen=KEPT)

    def still_since(self, glow: Glow) -> float | None:
        """Take the next glow; since when (Unix s) it has stood still while the Sun moved on; None if it has not."""
        begun = next((g.utc_unix_s for g in self._kept if g.stood_still(glow)), None)
        if not self._kept or abs(glow.utc_unix_s - self._kept[-1].utc_unix_s) >= APART_S:
            self._kept.append(glow)
        return begun

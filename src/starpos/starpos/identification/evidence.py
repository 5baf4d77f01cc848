# SPDX-License-Identifier: Apache-2.0
"""Evidence of a frame's stars that a pose is right, against chance.

By chance the detections are random points anywhere on the frame. If the pose is right, each detection, from the brightest
down, is one of two things. It is a false star, with a probability that follows from the share of false ones before it (a
rule of succession that starts with two right and one wrong). Or it is the j-th brightest of the catalogue's stars not yet
seen, with probability 1 / ((j + 1) (j + 2)), at that star's place to within its error.

The evidence is the ratio of the two probabilities, averaged over all possible poses. Under chance its mean is 1, so it
exceeds x in at most one of x frames of random points, at whatever detection one stops (Ville's inequality) and however
the pose was found. Here only the neighbourhood of one pose is counted, by Laplace's method. That is right to a small
factor, but all other poses are left out, so the result is on the safe side: with random points it exceeds 1 in one frame
of a hundred.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from starpos.identification._poses import Chances
from starpos.identification._search import Anywhere
from starpos.identification.pose import Pose
from starpos.identification.triangles import SCALE_TOLERANCE

# Extra centroid errors (px) and their prior probabilities: none, errors of the catalogue, unknown lenses.
ERRORS_PX, LOG_SHARES = np.array([0.0, 0.3, 1.0, 3.0]), np.log([0.6, 0.2, 0.1, 0.1])
# Limits on the error of the focal length's logarithm, and their probabilities.
SCALES = (0.003, 0.5), (SCALE_TOLERANCE + 0.005, 0.5)
# Probability that a frame is mirrored.
MIRRORED = 0.1
# Width of all rotations about each axis, and of the likeliest focal lengths.
WIDTH = np.append(np.full(3, np.cbrt(8 * np.pi**2)), 2 * SCALES[0][0])
# Closer detections may be the same star, so the second says nothing new.
DOUBLE_PX = 3.0
CHANCES = Chances(ERRORS_PX, LOG_SHARES, DOUBLE_PX)


@dataclass(frozen=True)
class Prior:
    """Prior knowledge of the pose.

    log_density  of a pose, per rad3 of rotation and unit of the focal length's logarithm; -inf if the pose is impossible
    width        (4,): size of the region of possible poses, rad about C's axes and in that logarithm. It limits the
                 volume of poses where the stars of a frame constrain the pose weakly.
    """

    log_density: Callable[[Pose], float]
    width: np.ndarray

    def log_density_at(self, attitude: np.ndarray, focal_px: float, mirrored: bool) -> float:
        """Logarithm of the density at a pose in its parts."""
        return self.log_density(Pose(attitude, focal_px, mirrored))


@lru_cache(maxsize=16)
def anywhere(focal_px: float, log_share: float = 0.0) -> Prior:
    """The Prior of a frame lost in space, with a focal length of about focal_px."""
    return Prior(Anywhere(focal_px, SCALES, MIRRORED, log_share), WIDTH)


def any_scale(shortest_px: float, longest_px: float, log_share: float = 0.0) -> Prior:
    """The Prior of a frame lost in space of which only a range of focal lengths (px) is known, all sizes alike."""
    logarithms = math.log(longest_px / shortest_px)

    def log_density(pose: Pose) -> float:
        parity = MIRRORED if pose.mirrored else 1 - MIRRORED
        known = shortest_px <= pose.focal_px <= longest_px
        return log_share + math.log(parity / (8 * math.pi**2 * logarithms)) if known else -math.inf

    return Prior(log_density, np.append(WIDTH[:3], logarithms))

# SPDX-License-Identifier: Apache-2.0
"""What a frame's stars say for a pose against chance: the evidence that the frame shows this part of the sky.

By chance they are random points anywhere on the frame.  If the frame shows the sky, each next detection, from the
brightest down, is either a false star, as often as those before it (a rule of succession, from two right and one wrong),
or the j-th brightest of the catalogue's stars not yet seen, with probability 1 / ((j + 1) (j + 2)), at its place to its
error.  The ratio of the two probabilities, averaged over all poses that could be, has a mean of 1 under chance: it
exceeds x at most once in x frames of random points, at whatever detection one stops (Ville's inequality) and however a
pose was come by.  What the surroundings of one pose contribute to it is less than all of it; Laplace's method takes it to
a factor of some, which the poses left out exceed by far: of random points the ratio exceeds 1 in one frame of a hundred.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from starpos.identification.pairs import close_pairs
from starpos.identification.pose import Pose, slopes

# The centroids' errors besides their own, px, and how often: none; a catalogue that is off; a lens nobody knows
ERRORS_PX, LOG_SHARES = np.array([0.0, 0.3, 1.0, 3.0]), np.log([0.6, 0.2, 0.1, 0.1])
SCALE_TOLERANCE = 0.03  # of the focal length
SCALES = (0.003, 0.5), (SCALE_TOLERANCE + 0.005, 0.5)  # how far off its logarithm may be, and how often
MIRRORED = 0.1  # of all frames
# of all rotations, about each axis; of the likeliest focal lengths
WIDTH = np.append(np.full(3, np.cbrt(8 * np.pi**2)), 2 * SCALES[0][0])
TEST_STARS = 50  # the brightest of a frame, which decide
EARLIER = np.tri(TEST_STARS, k=-1, dtype=bool)
DOUBLE_PX = 3.0  # detections this close may be one star, and then say nothing new


@dataclass(frozen=True)
class Prior:
    """What is known of the pose: log_density of one, per rad3 of rotation and unit of the focal length's logarithm, -inf
    where it cannot be; width (4,): of where it can, rad about C's axes and of that logarithm, so that a frame that tells
    less is given no more poses than there are.
    """

    log_density: Callable[[Pose], float]
    width: np.ndarray

    @property
    def information(self) -> np.ndarray:
        return np.diag(2 * np.pi / self.width**2)


def anywhere(focal_px: float, log_share: float = 0.0) -> Prior:
    """Lost in space with a focal length of about focal_px; rotations fill 8 pi2."""

    def log_density(pose: Pose) -> float:
        scale = abs(math.log(pose.focal_px / focal_px))
        density = sum(share / (2 * within) for within, share in SCALES if scale < within)
        parity = MIRRORED if pose.mirrored else 1 - MIRRORED
        return log_share + math.log(parity * density / (8 * math.pi**2)) if density else -math.inf

    return Prior(log_density, WIDTH)


def log_evidence(
    xy: np.ndarray,
    sigma_px: np.ndarray,
    area_px2: float,
    pose: Pose,
    prior: Prior,
    star: np.ndarray,
    rank: np.ndarray,
    w: np.ndarray,
) -> float:
    """Logarithm of the evidence for a pose that was fitted to matched stars.

    xy (N, 2), sigma_px (N,): the brightest detections, brightest first, on a frame of area_px2.  star (M,): which of
    them, ascending, are stars of the catalogue; rank (M,) of these in brightness on the frame; w (M, 3) their directions.
    """
    predicted, slope = slopes(pose, w)
    distance2 = np.square(xy[star] - predicted).sum(1)
    n = np.arange(len(xy))
    hit = np.zeros(len(xy), int)
    hit[star] = 1
    odds = np.empty((len(ERRORS_PX), len(xy)))
    odds[:] = (n - hit.cumsum() + hit + 1) / (n + 3)
    passed = rank - (EARLIER[: len(star), : len(star)] & (rank[:, None] > rank)).sum(1)
    right = (np.arange(len(star)) + 2) / (star + 3)
    variance = sigma_px[star] ** 2 + ERRORS_PX[:, None] ** 2
    density = np.exp(-0.5 * distance2 / variance) / (2 * np.pi * variance)
    odds[:, star] += right * area_px2 / ((passed + 1) * (passed + 2)) * density
    odds[:, close_pairs(xy, DOUBLE_PX)[1]] = 1.0
    slope = slope.reshape(-1, 4)
    information = slope.T @ slope / variance.min(1)[:, None, None] + prior.information
    volume = 0.5 * (4 * np.log(2 * np.pi) - np.linalg.slogdet(information)[1])
    best = np.log(odds).cumsum(1).max(1) + volume + LOG_SHARES
    return float(best.max() + prior.log_density(pose))

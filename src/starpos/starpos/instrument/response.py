# SPDX-License-Identifier: Apache-2.0
"""The response of an inclinometer: how its angles err at another lean than at the calibration.

Each axis has a zero and a scale, and each pair of axes an angle that is not square. A3 is fitted at the calibration's
lean, so these count only away from it; even a zero does, because a constant error of an angle is not a rotation.
"""

from dataclasses import dataclass
from itertools import combinations

import numpy as np

from starpos import rotation
from starpos.instrument.inclinometer import InclinometerErrors, up_slope

# number of coefficients by number of axes: zeros, scales, angles between axes
COEFFICIENTS = {2: 5, 3: 9}


def angles_at(up: np.ndarray, axes: int) -> np.ndarray:
    """The elevations (axes,) in rad of S's axes for up (3,) in S."""
    return np.arcsin(np.clip(up, -1, 1))[:axes]


@dataclass(frozen=True)
class Zeroed:
    """A lean at which the response counts nothing, because A3 was fitted there.

    theta (axes,): its angles.  turns (axes, 3): the rotation of S that moves up as an error of each angle does.
    """

    theta: np.ndarray
    turns: np.ndarray

    @classmethod
    def at(cls, up: np.ndarray, axes: int) -> "Zeroed":
        """The lean with up (3,) in S, for a sensor of `axes` axes."""
        theta = angles_at(up, axes)
        return cls(theta, rotation.cross(up, up_slope(theta, up).T))


def response_columns(theta: np.ndarray, up: np.ndarray, zeroed: Zeroed) -> np.ndarray:
    """Change (3, m) of up (3,) in S, as read at the angles theta (axes,), for each coefficient of the response.

    The m coefficients are the zeros (rad), the scales (shares) and, for each pair of axes, the share of one axis' angle
    that the other shows.
    """
    axes, lean = len(theta), (theta - zeroed.theta).tolist()
    # change of each angle for each coefficient
    angles = np.zeros((axes, COEFFICIENTS[axes]))
    for k in range(axes):
        angles[k, k], angles[k, axes + k] = 1.0, lean[k]
    for k, (i, j) in enumerate(combinations(range(axes), 2), 2 * axes):
        angles[i, k], angles[j, k] = lean[j], lean[i]
    columns = up_slope(theta, up) @ angles
    # a rotation of S by up x moved takes up there by `moved`
    columns[:, :axes] += rotation.cross_matrix(up) @ zeroed.turns.T
    return columns


def stated_variances(errors: InclinometerErrors, axes: int) -> np.ndarray:
    """Variances (m,) of the coefficients as the sensor's errors state them; its zero is part of A3's error."""
    pairs = axes * (axes - 1) // 2
    return np.array([0.0] * axes + [errors.scale**2] * axes + [errors.cross**2] * pairs)

# SPDX-License-Identifier: Apache-2.0
"""The response of an inclinometer: how its angles err at another lean than that of the calibration.

Each axis has a zero and a scale, and each pair of axes an angle that is not square. A3 is fitted at the calibration's
lean, so these count only away from it; a zero does so because an angle that is wrong by a constant is no rotation.
"""

from itertools import combinations

import numpy as np

from starpos import rotation
from starpos.instrument.inclinometer import InclinometerErrors, up_of, up_slope

# number of coefficients by number of axes: zeros, scales, angles between axes
COEFFICIENTS = {2: 5, 3: 9}


def angles_at(up: np.ndarray, axes: int) -> np.ndarray:
    """The elevations (axes,) in rad of S's axes for up (3,) in S."""
    return np.arcsin(np.clip(up, -1, 1))[:axes]


def response_columns(theta: np.ndarray, calibrated_up: np.ndarray) -> np.ndarray:
    """Change (3, m) of up in S, as read at the angles theta (axes,), for each coefficient of the response.

    calibrated_up (3,): up in S at the calibration. There all columns are 0, because A3 holds the rest.
    The m coefficients are the zeros (rad), the scales (shares) and, for each pair of axes, the share of one axis' angle
    that the other shows.
    """
    axes, then = len(theta), angles_at(calibrated_up, len(theta))
    slope, lean = up_slope(theta), theta - then
    # a rotation of S by up x moved takes up there by `moved`
    turns = rotation.cross(calibrated_up, up_slope(then).T)
    zeros = slope - rotation.cross(turns, up_of(theta)).T
    pairs = [slope[:, i] * lean[j] + slope[:, j] * lean[i] for i, j in combinations(range(axes), 2)]
    return np.column_stack([zeros, slope * lean, *pairs])


def stated_variances(errors: InclinometerErrors, axes: int) -> np.ndarray:
    """Variances (m,) of the coefficients as the sensor's errors state them; its zero is part of A3's error."""
    pairs = axes * (axes - 1) // 2
    return np.array([0.0] * axes + [errors.scale**2] * axes + [errors.cross**2] * pairs)

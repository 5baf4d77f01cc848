# SPDX-License-Identifier: Apache-2.0
"""Whether a camera stands against the Earth as it stood, was touched, or only its time stamps contradict each other.

A camera at rest sees the sky turn about the Earth's axis by its stamps; if by them it has turned about that axis itself,
as no hand turns it, one of the stamps is wrong.
"""

import numpy as np

from starpos import rotation
from starpos.earth.orientation import ROTATION_RAD_S
from starpos.fix.fix import Fix
from starpos.units import ARCSEC

SIGMAS = 6.0  # that errors may reach
CREEP_RAD = 10 * ARCSEC  # by which a mount may settle that nobody touches
HIGHEST_LATITUDE = np.radians(89.0)  # beyond it any turn on the spot is one about the Earth's axis
LARGE_TRACE = 2.9  # of a rotation by 0.3 rad; larger ones are no error


def slip_s(fix: Fix, first: Fix, stated_s: float = 0.0) -> float | None:
    """By how many seconds the stamps of two fixes of one pose contradict each other; None of a camera that was touched.

    0 within what the errors of both attitudes allow, the mount's creep, and stated_s, 1 sigma of both stamps together.
    """
    turned = fix.camera_to_itrs @ first.camera_to_itrs.T
    angle = np.arctan2(turned[1, 0] - turned[0, 1], turned[0, 0] + turned[1, 1])
    about_axis = rotation.about_axis(2, angle)
    rest = turned @ about_axis.T
    if np.trace(rest) < LARGE_TRACE:
        return None
    covariance = fix.camera_covariance + about_axis @ first.camera_covariance @ about_axis.T
    weight = np.linalg.inv(covariance + np.eye(3) * (CREEP_RAD / SIGMAS) ** 2)
    # the angle with the least rest: the roll about the optical axis is known worse than where that axis points
    rest, variance = rotation.to_small_vector(rest), 1 / weight[2, 2]
    more = variance * weight[2] @ rest
    rest, angle = rest - [0.0, 0.0, more], angle + more
    if rest @ weight @ rest > SIGMAS**2:
        return None
    if abs(angle) <= SIGMAS * np.sqrt(variance + (stated_s * ROTATION_RAD_S) ** 2):
        return 0.0
    return None if abs(fix.latitude) > HIGHEST_LATITUDE else float(abs(angle) / ROTATION_RAD_S)

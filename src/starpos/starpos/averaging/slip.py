# SPDX-License-Identifier: Apache-2.0
"""Distinguish a camera that was touched from one whose time stamps contradict each other.

For a camera at rest the sky turns about the Earth's axis as its time stamps say.  If by the stamps the camera itself has
turned about exactly that axis, which no hand does, one of the stamps is wrong.
"""

from collections.abc import Sequence
from typing import Protocol

import numpy as np

from starpos import rotation
from starpos.earth.orientation import ROTATION_RAD_S
from starpos.fix.fix import Fix
from starpos.units import ARCSEC

# errors may be as large as this
SIGMAS = 6.0
# maximum creep of an untouched mount
CREEP_RAD = 10 * ARCSEC
# beyond it any turn about the plumb line is one about the Earth's axis
HIGHEST_LATITUDE = np.radians(89.0)
# trace of a rotation by 0.3 rad; a larger rotation is no error
LARGE_TRACE = 2.9


class Sighted(Protocol):
    """Attitude of a camera against the Earth, as a Fix has it: a rotation (3, 3), its covariance (3, 3), a latitude."""

    @property
    def camera_to_itrs(self) -> np.ndarray: ...

    @property
    def camera_covariance(self) -> np.ndarray: ...

    @property
    def latitude(self) -> float: ...


def slip_s(fix: Sighted, first: Sighted, stated_s: float = 0.0) -> float | None:
    """Seconds by which the time stamps of two fixes contradict each other; None if the camera was touched in between.

    The result is 0 if the errors of both attitudes, the mount's creep and stated_s explain the difference.
    stated_s: 1 sigma of both stamps together.
    """
    turned = fix.camera_to_itrs @ first.camera_to_itrs.T
    angle = np.arctan2(turned[1, 0] - turned[0, 1], turned[0, 0] + turned[1, 1])
    about_axis = rotation.about_axis(2, angle)
    rest = turned @ about_axis.T
    if np.trace(rest) < LARGE_TRACE:
        return None
    covariance = fix.camera_covariance + about_axis @ first.camera_covariance @ about_axis.T
    weight = np.linalg.inv(covariance + np.eye(3) * (CREEP_RAD / SIGMAS) ** 2)
    # choose the angle that leaves the least rest in sigma: the roll is known worse than the optical axis
    rest, variance = rotation.to_small_vector(rest), 1 / weight[2, 2]
    more = variance * weight[2] @ rest
    rest, angle = rest - [0.0, 0.0, more], angle + more
    if rest @ weight @ rest > SIGMAS**2:
        return None
    if abs(angle) <= SIGMAS * np.sqrt(variance + (stated_s * ROTATION_RAD_S) ** 2):
        return 0.0
    return None if abs(fix.latitude) > HIGHEST_LATITUDE else float(abs(angle) / ROTATION_RAD_S)


def poses_of(fixes: Sequence[Fix]) -> np.ndarray:
    """Number (K,) of the pose of each fix, from 0: a pose lasts until somebody touches the camera."""
    poses, pose, first = np.zeros(len(fixes), int), -1, None
    for k in np.argsort([f.utc_unix_s for f in fixes], kind="stable"):
        if first is None or slip_s(fixes[k], first) is None:
            pose, first = pose + 1, fixes[k]
        poses[k] = pose
    return poses

# SPDX-License-Identifier: Apache-2.0
"""The response of an inclinometer: how its angles err at another lean than at the calibration.

Each axis has a zero and a scale, and each pair of axes an angle that is not square. A3 is fitted at the calibration's
lean, so these count only away from it; even a zero does, because a constant error of an angle is not a rotation.

Rotations between camera, inclinometer and base link, as matrices with their errors, and the level at a tilt.
"""

from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import combinations

import numpy as np

from starpos import rotation
from starpos._numeric.roots import symmetric_root
from starpos.errors import InstrumentError, TiltError
from starpos.frozen import at_once
from starpos.instrument.inclinometer import (
    EITHER_WAY,
    EXACT,
    UNMEASURED_JUMP_C,
    InclinometerErrors,
    Tilt,
    level_of,
    up_of,
    up_slope,
)

# number of coefficients by number of axes: zeros, scales, angles between axes
RESPONSE_COEFFICIENTS = {2: 5, 3: 9}


def angles_at(up: np.ndarray, axes: int) -> np.ndarray:
    """The elevations (axes,) in rad of S's axes for up (3,) in S."""
    return np.arcsin(np.clip(up, -1, 1))[:axes]


@lru_cache(maxsize=8)
def _zeroed(up: tuple[float, ...], axes: int) -> tuple[np.ndarray, np.ndarray]:
    """Angles (axes,) of a lean, and the rotation of S (axes, 3) that moves up there as an error of each angle does."""
    there = np.array(up)
    theta = angles_at(there, axes)
    return theta, rotation.cross(there, up_slope(theta, there).T)


def response_columns(theta: np.ndarray, up: np.ndarray, calibrated_up: np.ndarray) -> np.ndarray:
    """Change (3, m) of up (3,) in S, as read at the angles theta (axes,), for each coefficient of the response.

    calibrated_up (3,): where the response counts nothing, because A3 was fitted there.

    The m coefficients are the zeros (rad), the scales (shares) and, for each pair of axes, the share of one axis' angle
    that the other shows.
    """
    axes = len(theta)
    then, turns = _zeroed(tuple(calibrated_up.tolist()), axes)
    lean = (theta - then).tolist()
    # change of each angle for each coefficient
    angles = np.zeros((axes, RESPONSE_COEFFICIENTS[axes]))
    for k in range(axes):
        angles[k, k], angles[k, axes + k] = 1.0, lean[k]
    for k, (i, j) in enumerate(combinations(range(axes), 2), 2 * axes):
        angles[i, k], angles[j, k] = lean[j], lean[i]
    columns = up_slope(theta, up) @ angles
    # a rotation of S by up x moved takes up there by `moved`
    columns[:, :axes] += rotation.cross_matrix(up) @ turns.T
    return columns


def stated_variances(errors: InclinometerErrors, axes: int) -> np.ndarray:
    """Variances (m,) of the coefficients as the sensor's errors state them; its zero is part of A3's error."""
    pairs = axes * (axes - 1) // 2
    return np.array([0.0] * axes + [errors.scale**2] * axes + [errors.cross**2] * pairs)


# lower bound of the cosine that turns an error of the sine into one of the angle
MIN_COSINE = 0.1


@at_once
@dataclass(frozen=True)
class LocalLevel:
    """The local level L that a tilt shows through a mounting.

    up        (3,) in S, corrected by the response
    a2        (3, 3): S into L
    camera    (3, 3): C into L, A2 A3
    response  (3, m): change of up for 1 sigma of each error of the response
    """

    up: np.ndarray
    a2: np.ndarray
    camera: np.ndarray
    response: np.ndarray

    @cached_property
    def turns(self) -> np.ndarray:
        """Matrix (3, 3) from a change of up (3,) in S to a small rotation (3,) of L about its axes; zero about Z."""
        return np.array([self.a2[1], -self.a2[0], np.zeros(3)])


@at_once
@dataclass(frozen=True, kw_only=True)
class Mounting:
    """Rotations between camera, inclinometer and base link, and how well they are known.

    a3                        (3, 3): camera C into inclinometer S
    link_to_camera            (3, 3): base link into C
    link_stddev_rad           1 sigma of link_to_camera about each axis
    lens_stddev_rad           1 sigma of directions in C, about each axis across the optical one, by an unknown lens
    calibration_covariance    (3, 3) rad2 of A3 as a small rotation about S's axes; it includes the inclinometer's zero,
                              because only their sum matters
    remounted_rad             1 sigma about each axis of a turn of A3 since the calibration
    inclinometer              its errors
    calibrated_unix_s         time of the calibration; NaN: unknown, then the covariance includes the drift until now
    calibrated_temperature_c  temperature of the inclinometer then; NaN: unknown
    calibrated_tilt           its two or three angles then, rad; an error of its response grows with the distance from
                              them
    response                  (m,) coefficients of its response that were found, or ()
    response_covariance       (m, m) of these
    """

    a3: np.ndarray
    link_to_camera: np.ndarray
    calibration_covariance: np.ndarray
    link_stddev_rad: float = 0.0
    lens_stddev_rad: float = 0.0
    remounted_rad: float = 0.0
    inclinometer: InclinometerErrors = EXACT
    calibrated_unix_s: float = float("nan")
    calibrated_temperature_c: float = float("nan")
    calibrated_tilt: tuple[float, ...] = (0.0, 0.0)
    response: tuple[float, ...] = ()
    response_covariance: tuple = ()

    def warmer_c(self, tilt: Tilt) -> float:
        """The inclinometer's temperature at a tilt minus the calibration's; NaN if one is unknown."""
        return tilt.temperature_c - self.calibrated_temperature_c

    @property
    def unmeasured_c(self) -> float:
        """1 sigma of `warmer_c` where it is unknown.

        If a calibration has neither a date nor a temperature, its stated error holds for all temperatures: 0.
        """
        dated = np.isfinite([self.calibrated_unix_s, self.calibrated_temperature_c]).any()
        return UNMEASURED_JUMP_C if dated else 0.0

    @cached_property
    def calibrated_up(self) -> np.ndarray:
        """Up (3,) in S at the calibration."""
        return up_of(np.asarray(self.calibrated_tilt))

    @cached_property
    def calibration_root(self) -> np.ndarray:
        """The symmetric root (3, 3) in rad of the calibration's covariance."""
        return symmetric_root(self.calibration_covariance)

    def level(self, tilt: Tilt) -> LocalLevel:
        """The level at a tilt; InstrumentError if the response is of a sensor with another number of axes.

        TiltError if it may point up or down.

        Zeros that were not calibrated are assumed to err by the contradiction of the axes.
        """
        if tilt.either_way:
            raise TiltError(EITHER_WAY)
        if self.response:
            columns = response_columns(tilt.theta, tilt.up, self.calibrated_up)
            if columns.shape[1] != len(self.response):
                raise InstrumentError(
                    f"the calibration's response has {len(self.response)} coefficients, and a tilt of {tilt.axes} axes "
                    f"needs {columns.shape[1]}: calibrate with the inclinometer that is used"
                )
            up, response = (
                rotation.normalised(tilt.up - columns @ self.response),
                columns @ self._response_root,
            )
        else:
            # with three axes the consistent angles, as at the calibration: so nothing counts at its lean
            up, theta = tilt.up, angles_at(tilt.up, tilt.axes)
            variances = stated_variances(self.inclinometer, tilt.axes)
            wrong = self.inclinometer.contradiction(tilt) / np.maximum(np.cos(theta), MIN_COSINE)
            variances[: tilt.axes] += wrong**2
            response = response_columns(theta, tilt.up, self.calibrated_up) * np.sqrt(variances)
        a2 = level_of(up)
        return LocalLevel(up, a2, a2 @ self.a3, response)

    @cached_property
    def _response_root(self) -> np.ndarray:
        return symmetric_root(self.response_covariance)

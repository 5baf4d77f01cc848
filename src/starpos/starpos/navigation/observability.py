# SPDX-License-Identifier: Apache-2.0
"""The unknown that contributes most to the place's error under way, and the action that would determine it."""

from dataclasses import dataclass

import numpy as np

from starpos.earth.ellipsoid import enu_axes
from starpos.earth.gravity import geodetic_place
from starpos.navigation.estimate import Estimate
from starpos.navigation.motion import ACCEL_BIAS, BY_LAW, DRIFT, MOUNT, PLACE, SPEED, VELOCITY

# a claim of less needs no advice, m an axis
ENOUGH_M = 200.0
# an unknown counts by which at least this share of the error comes
SHARE = 0.5
BIAS, CAMERA, MOTION, WHOLE = (
    "turn once: the accelerometer's bias is not known",
    "turn once: how the camera sits on the IMU is not known",
    "measure the velocity: how it changes is not known",
    "go on and turn: the longer the record, the narrower the claim",
)


@dataclass(frozen=True, kw_only=True)
class Observability:
    """What is known of the place, 1 sigma an axis in m, and what is missing, '' where that is enough."""

    sigma_m: float
    missing: str


def observability(estimate: Estimate, measured: bool) -> Observability:
    """Which unknown an estimate's place depends on: by how much its error would shrink if that were known.

    measured: whether a velocity is measured, so that nothing else would determine it.
    """
    covariance = estimate.covariance
    latitude, longitude, _ = (float(x) for x in geodetic_place(estimate.motion.place[0]))
    level = enu_axes(latitude, longitude)[:2]
    place = level @ covariance[PLACE, PLACE] @ level.T
    sigma_m = float(np.sqrt(np.trace(place) / 2))
    if sigma_m < ENOUGH_M:
        return Observability(sigma_m=sigma_m, missing="")
    n = estimate.unknowns
    speed = np.r_[VELOCITY, SPEED, DRIFT] if n == BY_LAW else np.r_[VELOCITY]
    groups = {BIAS: np.r_[ACCEL_BIAS], CAMERA: n + np.r_[MOUNT]} | ({} if measured else {MOTION: speed})
    share = {}
    for sentence, columns in groups.items():
        across = level @ covariance[PLACE, columns]
        told = across @ np.linalg.pinv(covariance[np.ix_(columns, columns)]) @ across.T
        share[sentence] = float(np.trace(told) / np.trace(place))
    most = max(share, key=lambda sentence: share[sentence])
    return Observability(sigma_m=sigma_m, missing=most if share[most] > SHARE else WHOLE)

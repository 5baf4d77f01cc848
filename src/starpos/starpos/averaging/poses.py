# SPDX-License-Identifier: Apache-2.0
"""Poses of a camera that stands still: whether it was touched, whether its time stamps slipped, and its mean attitude."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from starpos import rotation
from starpos._numeric.roots import symmetric_root
from starpos.earth.orientation import ROTATION_RAD_S
from starpos.errors import FixError
from starpos.fix.attitude import Attitude
from starpos.fix.fix import Fix, angle_text
from starpos.fix.heading import AttitudeAtPlace
from starpos.fix.terms import ErrorTerm, total_covariance
from starpos.units import ARCSEC

# errors may be as large as this
SLIP_SIGMAS = 6.0
# maximum creep of an untouched mount
CREEP_RAD = 10 * ARCSEC
# beyond it any turn about the plumb line is one about the Earth's axis
HIGHEST_LATITUDE = np.radians(89.0)
# trace of a rotation by 0.3 rad; a larger rotation is no error
LARGE_TRACE = 2.9


def slip_s(camera: Attitude, first: Attitude, latitude: float, stated_s: float = 0.0) -> float | None:
    """Seconds by which the time stamps of two frames contradict each other; None if the camera was touched in between.

    The result is 0 if the errors of both attitudes, the mount's creep and stated_s explain the difference.
    camera, first: attitudes of C against ITRS.  latitude: of the camera, rad.
    stated_s: 1 sigma of both stamps together.
    """
    turned = camera.rotation @ first.rotation.T
    angle = np.arctan2(turned[1, 0] - turned[0, 1], turned[0, 0] + turned[1, 1])
    about_axis = rotation.about_axis(2, angle)
    rest = turned @ about_axis.T
    if np.trace(rest) < LARGE_TRACE:
        return None
    covariance = camera.covariance + about_axis @ first.covariance @ about_axis.T
    weight = np.linalg.inv(covariance + np.eye(3) * (CREEP_RAD / SLIP_SIGMAS) ** 2)
    # choose the angle that leaves the least rest in sigma: the roll is known worse than the optical axis
    rest, variance = rotation.to_small_vector(rest), 1 / weight[2, 2]
    more = variance * weight[2] @ rest
    rest, angle = rest - [0.0, 0.0, more], angle + more
    if rest @ weight @ rest > SLIP_SIGMAS**2:
        return None
    if abs(angle) <= SLIP_SIGMAS * np.sqrt(variance + (stated_s * ROTATION_RAD_S) ** 2):
        return 0.0
    return None if abs(latitude) > HIGHEST_LATITUDE else float(abs(angle) / ROTATION_RAD_S)


def poses_of(fixes: Sequence[Fix]) -> np.ndarray:
    """Number (K,) of the pose of each fix, from 0: a pose lasts until somebody touches the camera."""
    poses, pose, first = np.zeros(len(fixes), int), -1, None
    for k in np.argsort([f.utc_unix_s for f in fixes], kind="stable"):
        if first is None or slip_s(fixes[k].camera, first.camera, fixes[k].latitude) is None:
            pose, first = pose + 1, fixes[k]
        poses[k] = pose
    return poses


# the variance of a frame without errors of its own
TINY_RAD2 = 1e-18
# a frame of a camera at rest gets beyond it once in 1e6 frames
TURN_SIGMAS = 5.5


@dataclass(frozen=True, eq=False, kw_only=True)
class MeanAttitude:
    """Mean attitude of `frames` frames, by the plumb line and by the ellipsoid, at their mean time; `optics` of C."""

    utc_unix_s: float
    frames: int
    plumb: Attitude
    ellipsoid: Attitude
    optics: Attitude


def mean_attitude(attitudes: Sequence[AttitudeAtPlace]) -> MeanAttitude:
    """The weighted mean of one or more frames; FixError if the camera turned between them."""
    cameras = np.array([a.camera.rotation for a in attitudes])
    # by what each frame does not share with the others: few stars, as through dew, count for little
    weight = np.array([1 / max(np.trace(a.optics.unshared), TINY_RAD2) for a in attitudes])
    weight /= weight.sum()
    mean = rotation.mean_rotation(cameras, weight)
    for attitude, camera in zip(attitudes, cameras, strict=True):
        off = rotation.to_vector(camera @ mean.T)
        if off @ np.linalg.solve(attitude.camera.covariance, off) > TURN_SIGMAS**2:
            turned = angle_text(float(np.linalg.norm(off)))
            raise FixError(
                f"the camera turned between the frames, by {turned} from their mean: each frame has its own heading"
            )
    return MeanAttitude(
        utc_unix_s=float(np.mean([a.utc_unix_s for a in attitudes])),
        frames=len(attitudes),
        plumb=_mean([a.plumb for a in attitudes], weight),
        ellipsoid=_mean([a.ellipsoid for a in attitudes], weight),
        optics=_mean([a.optics for a in attitudes], weight),
    )


def _mean(links: Sequence[Attitude], weight: np.ndarray) -> Attitude:
    """The mean of attitudes whose budgets name the same sources in the same order; the weights add up to 1."""
    mean = rotation.mean_rotation(np.array([link.rotation for link in links]), weight)
    terms = tuple(_mean_term(of_each, weight) for of_each in zip(*(k.terms for k in links), strict=True))
    return replace(links[0], rotation=mean, covariance=total_covariance(terms)[3:, 3:], terms=terms)


def _mean_term(terms: Sequence[ErrorTerm], weight: np.ndarray) -> ErrorTerm:
    """One source's term: errors that are new in each frame average away, those that are shared do not."""
    first = terms[0]
    if first.shared is None:
        covariance = np.tensordot(weight**2, [t.covariance for t in terms], 1)
        return ErrorTerm(first.name, symmetric_root(covariance), origin=first.origin)
    shared = np.tensordot(weight, [t.factor for t in terms], 1)
    return ErrorTerm(first.name, shared, shared=first.shared, origin=first.origin)

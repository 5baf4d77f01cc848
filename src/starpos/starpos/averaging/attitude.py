# SPDX-License-Identifier: Apache-2.0
"""The attitude of a camera that stood still at a known place, as the mean of its frames'."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from starpos import rotation
from starpos._numeric.roots import symmetric_root
from starpos.errors import FixError
from starpos.fix.attitude_at_place import AttitudeAtPlace, LinkAttitude
from starpos.fix.budget import ErrorTerm
from starpos.fix.readable import angle_text

# a frame of a camera at rest gets beyond it once in 1e6 frames
SIGMAS = 5.5


@dataclass(frozen=True, eq=False, kw_only=True)
class MeanAttitude:
    """Mean attitude of `frames` frames, by the plumb line and by the ellipsoid, at their mean time."""

    utc_unix_s: float
    frames: int
    plumb: LinkAttitude
    ellipsoid: LinkAttitude


def mean_attitude(attitudes: Sequence[AttitudeAtPlace]) -> MeanAttitude:
    """The mean of one or more frames; FixError if the camera turned between them."""
    cameras = np.array([a.camera_to_itrs for a in attitudes])
    axes = np.tile(np.eye(3), (len(cameras), 1))
    mean = rotation.best_rotation(axes, np.concatenate(cameras.swapaxes(1, 2)))
    for attitude, camera in zip(attitudes, cameras, strict=True):
        off = rotation.to_vector(camera @ mean.T)
        if off @ np.linalg.solve(attitude.camera_covariance, off) > SIGMAS**2:
            turned = angle_text(float(np.linalg.norm(off)))
            raise FixError(
                f"the camera turned between the frames, by {turned} from their mean: each frame has its own heading"
            )
    return MeanAttitude(
        utc_unix_s=float(np.mean([a.utc_unix_s for a in attitudes])),
        frames=len(attitudes),
        plumb=_mean([a.plumb for a in attitudes]),
        ellipsoid=_mean([a.ellipsoid for a in attitudes]),
    )


def _mean(links: Sequence[LinkAttitude]) -> LinkAttitude:
    """The mean of attitudes whose budgets name the same sources in the same order."""
    axes = np.tile(np.eye(3), (len(links), 1))
    mean = rotation.best_rotation(axes, np.concatenate([link.link_to_enu.T for link in links]))
    return LinkAttitude(
        link_to_enu=mean, terms=tuple(map(_mean_term, zip(*(k.terms for k in links), strict=True)))
    )


def _mean_term(terms: Sequence[ErrorTerm]) -> ErrorTerm:
    """One source's term: errors that are new in each frame average away, those that are shared do not."""
    first = terms[0]
    if first.shared is None:
        covariance = np.sum([t.covariance for t in terms], axis=0) / len(terms) ** 2
        return ErrorTerm(first.name, symmetric_root(covariance), origin=first.origin)
    return ErrorTerm(
        first.name, np.mean([t.factor for t in terms], axis=0), shared=first.shared, origin=first.origin
    )

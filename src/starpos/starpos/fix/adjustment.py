# SPDX-License-Identifier: Apache-2.0
"""The attitude and plate scale that fit a frame's stars best, and which stars are outliers.

The residuals are formed in pixels, because the errors of the stars are known there.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from starpos.earth.ellipsoid import ECCENTRICITY2
from starpos.earth.orientation import EQUATOR_M_PER_S, SPEED_OF_LIGHT
from starpos.earth.refraction import Refraction
from starpos.errors import FixError
from starpos.fix._adjustment import Adjustment
from starpos.fix.outliers import judged
from starpos.frozen import at_once
from starpos.instrument.camera import Camera

MAX_ROUNDS = 6
MIN_STARS = 3
# the iteration ends at a step below this, in rad and as a share of the scale: the remaining error is a thousandth of it
SETTLED, MAX_STEPS = 1e-11, 20
# the rounds end when the scatter changes by less than this share of itself, and of this minimum, px2
SAME_SHARE, SAME_PX2 = 0.02, 1e-6
# a covariance that is the same in all directions
ISOTROPIC = np.eye(2)


@at_once
@dataclass(frozen=True, kw_only=True)
class Fitted:
    """A4 (3, 3), ITRS into L, and the factor on the focal length, from N stars.

    slope (N, 2, 4): derivatives of their places, px, by a small rotation about L's axes and a relative change of scale.
    residual (N, 2): places by the fit minus seen places, px.
    keep (N,): which of them are not outliers.  jitter2: their scatter beyond the stated errors, px2.
    """

    a4: np.ndarray
    scale: float
    slope: np.ndarray
    residual: np.ndarray
    keep: np.ndarray
    jitter2: float

    @cached_property
    def kept(self) -> slice | np.ndarray:
        """Rows that are not outliers; a slice of all, without a copy, in the usual case."""
        return slice(None) if self.keep.all() else self.keep


def adjustment_of(
    xy: np.ndarray, camera: Camera, g: np.ndarray, itrs: np.ndarray, refraction: Refraction
) -> Adjustment:
    """The problem of N stars, seen at xy (N, 2) px, in the geocentric apparent directions itrs (N, 3).

    g (3, 3): A2 A3, which takes C into L.
    """
    intrinsics = camera.fx, camera.fy, camera.cx, camera.cy
    ground = EQUATOR_M_PER_S / SPEED_OF_LIGHT, ECCENTRICITY2
    return Adjustment(xy, itrs, g, camera.lens, intrinsics, refraction.compiled, *ground)


def fitted(problem: Adjustment, local: np.ndarray, stated: np.ndarray) -> Fitted:
    """The fit of the stars, from a closed solution by Gauss-Newton over the rotation A4 and the plate scale.

    The derivatives are computed once: they hardly change over the remaining arcseconds.
    local (N, 3): unrefracted directions in L by the given focal length.  stated (N, 2, 2): covariances of places, px2.
    Raises FixError if the stars are too few or do not agree.
    """
    a4, scale, settled = problem.closed_form(local), 1.0, False
    slope = problem.jacobian(a4, scale)
    keep, jitter2 = np.ones(len(local), bool), 0.0
    for _ in range(MAX_ROUNDS):
        if np.count_nonzero(keep) < max(MIN_STARS, 0.5 * len(keep)):
            raise FixError(
                f"only {np.count_nonzero(keep)} of {len(keep)} identified stars agree on one attitude: no fix from them"
            )
        covariance = np.ascontiguousarray(stated + ISOTROPIC * jitter2)
        a4, scale, residual = problem.refine(
            a4, scale, slope, covariance, keep.view(np.uint8), SETTLED, MAX_STEPS
        )
        if residual is None:
            raise FixError(
                "the identified stars do not fit into the camera's field: check focal length and tilt"
            )
        if settled:
            break
        before = keep, jitter2
        jitter2, keep = judged(residual, stated, keep, share_free(keep))
        change = abs(jitter2 - before[1])
        settled = np.array_equal(keep, before[0]) and change <= SAME_SHARE * (jitter2 + SAME_PX2)
    return Fitted(a4=a4, scale=scale, slope=slope, residual=residual, keep=keep, jitter2=jitter2)


def share_free(keep: np.ndarray) -> float:
    """Share of the 2 N coordinates of N kept stars that four parameters leave free."""
    kept = np.count_nonzero(keep)
    return max(1 - 2 / kept, 1 / kept)

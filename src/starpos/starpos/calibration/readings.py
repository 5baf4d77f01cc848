# SPDX-License-Identifier: Apache-2.0
"""Attitudes and tilts of frames, with all that the tilts may err by, as the fit of the plumb line takes them."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from starpos import rotation
from starpos.averaging.slip import poses_of
from starpos.earth.ellipsoid import EARTH_RADIUS_M
from starpos.errors import FixError
from starpos.fix.budget import EACH_POSE
from starpos.fix.fix import Fix
from starpos.instrument.inclinometer import InclinometerErrors, Tilt
from starpos.instrument.response import COEFFICIENTS, Zeroed, response_columns, stated_variances

# sigma of a coefficient that is as good as known
KNOWN = 1e-9
# minimum significance of a lean, which errors of the tilts do not reach
LEAN_SIGMA = 5.0


@dataclass(frozen=True)
class FixedFrame:
    """A frame's fix, and the tilt that it was made with."""

    fix: Fix
    tilt: Tilt


@dataclass(frozen=True, kw_only=True)
class Readings:
    """Attitudes and tilts of K frames.

    utc_unix_s (K,).  to_camera (K, 3, 3): ITRS into C.  plumb (K, 3): up in S as the inclinometer reads it.  heading
    (K,) in rad. sigma (K,) in rad: of the zenith from each frame alone.
    pose (K,): number of each frame's pose, from 0.  pose_sigma (rad): of an error that is new at each pose.
    columns (K, 3, M): change of `plumb` for each of M errors of the inclinometer that frames share: its drift and its
    temperature in units of their sigma, then its response.  column_sigma (M,): 1 sigma of these.
    """

    utc_unix_s: np.ndarray
    to_camera: np.ndarray
    plumb: np.ndarray
    heading: np.ndarray
    sigma: np.ndarray
    pose: np.ndarray
    pose_sigma: float
    columns: np.ndarray
    column_sigma: np.ndarray

    @classmethod
    def of(cls, solved: Sequence[FixedFrame], errors: InclinometerErrors) -> "Readings":
        """Readings of frames with a fix; FixError if some have two axes and some three."""
        fixes = [s.fix for s in solved]
        plumb = np.array([s.tilt.up for s in solved])
        axes = {s.tilt.axes for s in solved}
        if len(axes) != 1:
            raise FixError("some tilts have two axes and some three: give the tilts of one inclinometer")
        mean = rotation.normalised(plumb.sum(0))
        zeroed = Zeroed.at(mean, min(axes))
        response = np.array([response_columns(s.tilt.theta, s.tilt.up, zeroed) for s in solved])
        walked = _wandering(solved, errors)
        variances = stated_variances(errors, axes.pop())
        return cls(
            utc_unix_s=np.array([f.utc_unix_s for f in fixes]),
            to_camera=np.array([f.camera_to_itrs.T for f in fixes]),
            plumb=plumb,
            heading=np.array([f.heading for f in fixes]),
            sigma=_own_sigma(fixes),
            pose=poses_of(fixes),
            pose_sigma=errors.pose_rad,
            columns=np.concatenate([walked, response], 2),
            column_sigma=np.concatenate([np.ones(walked.shape[2]), np.maximum(np.sqrt(variances), KNOWN)]),
        )

    def take(self, rows: np.ndarray) -> "Readings":
        """The readings of the frames in `rows`."""
        per_frame = ("utc_unix_s", "to_camera", "plumb", "heading", "sigma", "columns")
        pose = np.unique(self.pose[rows], return_inverse=True)[1]
        return replace(self, pose=pose, **{name: getattr(self, name)[rows] for name in per_frame})

    @property
    def mean_plumb(self) -> np.ndarray:
        """Mean direction (3,) of `plumb`."""
        return rotation.normalised(self.plumb.sum(0))

    @property
    def spread(self) -> np.ndarray:
        """Sigma (K,) in rad of frames with the errors of poses, so that all frames of a pose are no better than one."""
        return np.sqrt(self.sigma**2 + np.bincount(self.pose)[self.pose] * self.pose_sigma**2)

    def lean(self, pose_sigma: float) -> bool:
        """Whether the tilt changes from pose to pose by more than errors of that sigma (rad) make it seem to."""
        off = np.linalg.norm(self.plumb - self.mean_plumb, axis=1)
        return bool((off > LEAN_SIGMA * replace(self, pose_sigma=pose_sigma).spread).any())

    @property
    def response(self) -> slice:
        """The columns of the response."""
        return slice(self.columns.shape[2] - COEFFICIENTS[self._axes], self.columns.shape[2])

    @property
    def _axes(self) -> int:
        # drift and temperature have a column an axis
        return {2 * axes + number: axes for axes, number in COEFFICIENTS.items()}[self.columns.shape[2]]


def _own_sigma(fixes: Sequence[Fix]) -> np.ndarray:
    """Sigma per axis (K,) in rad of each frame's zenith, without the errors of poses and those that all frames share.

    An error that some frames share (a reading, the same stars) counts as an own error of each of them, enlarged so much
    that together they know the zenith no better than one.
    """
    terms = [[(k, t) for k, t in enumerate(f.terms) if not t.common and t.shared != EACH_POSE] for f in fixes]
    frames = Counter((k, key) for own in terms for k, t in own for key in t.shared or ())
    variance = [
        sum(
            np.trace(t.covariance[:2, :2]) / 2 * max((frames[k, key] for key in t.shared or ()), default=1)
            for k, t in own
        )
        for own in terms
    ]
    return np.sqrt(variance) / EARTH_RADIUS_M


def _wandering(solved: Sequence[FixedFrame], errors: InclinometerErrors) -> np.ndarray:
    """Change (K, 3, 2 axes) of up by drift and temperature of each axis, counted from the means of the frames."""
    hours = np.array([s.fix.utc_unix_s for s in solved]) / 3600
    warm = np.array([s.tilt.temperature_c for s in solved])
    late = (hours - hours.mean()) / max(np.sqrt(np.ptp(hours)), 1e-9)
    warm = warm - np.mean(warm) if np.isfinite(warm).all() else np.zeros(len(warm))
    slope = np.array([s.tilt.slope for s in solved])
    known = late * errors.drift_rad_per_sqrt_hour, warm * errors.temperature_rad_per_c
    return np.concatenate([slope * off[:, None, None] for off in known], 2)

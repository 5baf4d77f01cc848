# SPDX-License-Identifier: Apache-2.0
"""Terms of an error budget: what one source of error does, and which frames share it."""

import math
from collections.abc import Iterable
from dataclasses import KW_ONLY, dataclass
from enum import Enum

import numpy as np

from starpos.frozen import at_once

# Values of `ErrorTerm.shared`. The average of several fixes replaces EACH_POSE by the key of the pose, which a single fix
# does not know.
ALWAYS, EACH_POSE = ("always",), ("pose",)


class Origin(Enum):
    """Origin of an error. What GNSS teaches (starpos.gnss) replaces the terms of A3 and INCLINOMETER."""

    A3 = "the angle between camera and inclinometer"
    INCLINOMETER = "errors of the inclinometer that last longer than one frame"
    READINGS = "noise of the tilts of one frame"
    OTHER = "stars, air, time, mount"


@at_once
@dataclass(frozen=True)
class ErrorTerm:
    """One source of error: its covariance is variance * factor @ factor.T.

    factor (r, m): its rows are what the owner of the budget asks for; of a fix, r = 6, they are east m, north m, heading
    rad, and the attitude's small rotation about east, north, up in rad.
    shared: which frames have the same error.  None: each frame has a new one.  ALWAYS: all frames share it, as for a
    calibration or a clock.  EACH_POSE: all frames share it until the instrument is touched.  Any other tuple: the keys of
    the readings or stars of which the error is the mean; the errors of two frames have the `correlation` of their keys.
    walk_s: growth of the variance per second, for an error that wanders.
    constant_within_pose: the true factor stays the same until the camera is touched.  Factors of the frames of a pose
    differ only by noise, so an average uses the first one's.
    origin: what the error comes from.
    kernel (N, N): covariance, in units of the factor's, from frame to frame of an error of N frames together, which
    `of_frames` makes; then the factor has the rows of each frame in turn.
    """

    name: str
    factor: np.ndarray
    _: KW_ONLY
    shared: tuple | None = None
    variance: float = 1.0
    walk_s: float = 0.0
    constant_within_pose: bool = False
    origin: Origin = Origin.OTHER
    kernel: np.ndarray | None = None

    @classmethod
    def of_frames(cls, name: str, factors: np.ndarray, kernel: np.ndarray | None = None) -> "ErrorTerm":
        """The error of N frames together, with factors (N, r, m); without a kernel they share it."""
        return cls(name, factors.reshape(-1, factors.shape[2]), shared=ALWAYS, kernel=kernel)

    @property
    def covariance(self) -> np.ndarray:
        """Covariance of the rows of `factor`, (6, 6) of a fix's."""
        covariance = self.variance * self.factor @ self.factor.T
        if self.kernel is None:
            return covariance
        rows = len(self.factor) // len(self.kernel)
        return np.repeat(np.repeat(self.kernel, rows, 0), rows, 1) * covariance

    @property
    def common(self) -> bool:
        """Whether the error is the same in all frames."""
        return self.shared == ALWAYS


def total_covariance(terms: Iterable[ErrorTerm]) -> np.ndarray:
    """Sum of the covariances of independent terms, (6, 6) if their factors have six rows."""
    roots = np.hstack([t.factor if t.variance == 1.0 else t.factor * math.sqrt(t.variance) for t in terms])
    return roots @ roots.T


def correlation(a: tuple, b: tuple) -> float:
    """Correlation of the means of two sets of equally good readings that have the keys `a` and `b`."""
    return len(set(a) & set(b)) / (len(a) * len(b)) ** 0.5 if a and b else 0.0

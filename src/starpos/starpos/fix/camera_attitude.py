# SPDX-License-Identifier: Apache-2.0
"""The attitude of a camera among the stars, which needs neither place nor level."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False, kw_only=True)
class CameraAttitude:
    """Attitude of the camera at one time, by its stars alone.

    utc_unix_s: middle of the exposure, None where it is not known; stamp_stddev_s, clock_stddev_s: of that stamp, and
    of the clock that made it against UTC.  frame_id: the camera's, in a graph of nodes.
    camera_to_gcrs (3, 3): axes of the camera to the axes of GCRS, which are ICRS's, for directions without annual
    aberration but with refraction and diurnal aberration, which need a place.
    covariance (3, 3): rad2, of its small rotation about the camera's axes.  stars, log_odds: of the identification.
    """

    utc_unix_s: float | None
    stamp_stddev_s: float
    clock_stddev_s: float
    frame_id: str
    camera_to_gcrs: np.ndarray
    covariance: np.ndarray
    stars: int
    log_odds: float

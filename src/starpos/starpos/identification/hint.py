# SPDX-License-Identifier: Apache-2.0
"""What a fix says of the next frame: the camera stands where it stood, or was only turned, or driven some way."""

from dataclasses import dataclass

import numpy as np

from starpos.earth.ellipsoid import zenith_of
from starpos.earth.orientation import EarthState
from starpos.identification import Identification, PlumbPrior, PointingPrior
from starpos.units import ARCSEC

PLUMB_TOLERANCE_RAD = 90 * ARCSEC  # 2.8 km of travel, or as much error of the tilt


@dataclass(frozen=True)
class Hint:
    """itrs_to_camera (3, 3), up_itrs (3,): how the camera stood on the Earth, and where; focal_px: what it had then."""

    itrs_to_camera: np.ndarray
    up_itrs: np.ndarray
    focal_px: float

    @classmethod
    def at(
        cls, found: Identification, state: EarthState, focal_px: float, latitude: float, longitude: float
    ) -> "Hint":
        """From an identification and the astronomic place (rad) that came of it; focal_px is the fitted one."""
        return cls(found.attitude @ state.gcrs_to_itrs.T, zenith_of(latitude, longitude), focal_px)

    def priors(self, state: EarthState, zenith_camera: np.ndarray) -> tuple[PointingPrior, PlumbPrior]:
        """For `identify` at another time: the attitude if nothing moved, else the plumb line zenith_camera (3,), in C."""
        return (
            PointingPrior(self.itrs_to_camera @ state.gcrs_to_itrs, self.focal_px),
            PlumbPrior(self.up_itrs @ state.gcrs_to_itrs, zenith_camera, PLUMB_TOLERANCE_RAD),
        )

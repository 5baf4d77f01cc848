# SPDX-License-Identifier: Apache-2.0
"""Priors for the next frame from a fix: the camera has not moved, or it was only turned, or moved a short way."""

from dataclasses import dataclass

import numpy as np

from starpos.earth.ellipsoid import zenith_of
from starpos.earth.orientation import EarthState
from starpos.identification import Identification, PlumbPrior, PointingPrior
from starpos.units import ARCSEC

# 2.8 km of travel, or an error of the tilt of that size.
PLUMB_TOLERANCE_RAD = 90 * ARCSEC


@dataclass(frozen=True)
class Hint:
    """Attitude and place of the camera at the time of a fix.

    itrs_to_camera  (3, 3): ITRS into C
    up_itrs         (3,): the zenith in ITRS
    focal_px        fitted focal length, px
    """

    itrs_to_camera: np.ndarray
    up_itrs: np.ndarray
    focal_px: float

    @classmethod
    def at(
        cls, found: Identification, state: EarthState, focal_px: float, latitude: float, longitude: float
    ) -> "Hint":
        """Make a Hint from an identification, the fitted focal length, and the astronomic place (rad) of its fix."""
        return cls(found.attitude @ state.gcrs_to_itrs.T, zenith_of(latitude, longitude), focal_px)

    def priors(self, state: EarthState, zenith_camera: np.ndarray) -> tuple[PointingPrior, PlumbPrior]:
        """Priors for `identify` at another time: the attitude if nothing moved, and the zenith (3,) in C."""
        return (
            PointingPrior(self.itrs_to_camera @ state.gcrs_to_itrs, self.focal_px),
            PlumbPrior(self.up_itrs @ state.gcrs_to_itrs, zenith_camera, PLUMB_TOLERANCE_RAD),
        )

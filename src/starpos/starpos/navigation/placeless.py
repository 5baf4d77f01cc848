# SPDX-License-Identifier: Apache-2.0
"""Frames that give only the camera's attitude among the stars, not the stars themselves."""

from dataclasses import dataclass

import numpy as np

from starpos import rotation
from starpos.earth.orientation import earth_state, station_velocity
from starpos.earth.refraction import Atmosphere
from starpos.fix.camera_attitude import CameraAttitude
from starpos.navigation.sightings import StarAttitude, roughly

# Refraction squeezes a frame more along the vertical than across. This turns the attitude across the axis if the middle
# of the stars is off the axis (rad), and about it if stars spread farther one way than the other (share): 1 sigma.
OFF_AXIS, SPREAD = 0.03, 0.25
# sine of the lowest altitude that this is for
LOWEST = 0.1
CIRCLE = np.array([[np.cos(a), np.sin(a)] for a in np.arange(8) * np.pi / 4])


@dataclass(frozen=True, eq=False, kw_only=True)
class PlacelessFrame:
    """An attitude camera_to_itrs (3, 3) without refraction and diurnal aberration, as CameraAttitude has it."""

    utc_unix_s: float
    stamp_stddev_s: float
    camera_to_itrs: np.ndarray
    covariance: np.ndarray

    @classmethod
    def of(cls, attitude: CameraAttitude) -> "PlacelessFrame":
        """The frame of an attitude that has a time; TimeError outside the IERS tables."""
        assert attitude.utc_unix_s is not None
        return cls(
            utc_unix_s=attitude.utc_unix_s,
            stamp_stddev_s=attitude.stamp_stddev_s,
            camera_to_itrs=earth_state(attitude.utc_unix_s).gcrs_to_itrs @ attitude.camera_to_gcrs,
            covariance=attitude.covariance,
        )

    def rough(self) -> StarAttitude:
        """The attitude where nothing is known of the place."""
        return roughly(self.camera_to_itrs)

    def under(self, zenith: np.ndarray, atmosphere: Atmosphere) -> StarAttitude:
        """The attitude under a zenith (3,) in ITRS, from where stars around the camera's axis would be seen there.

        The attitude's covariance gives the distance of the frame's own stars from it.  The fitted plate scale has
        absorbed the effect of refraction that is the same in all directions.  The covariance contains the rest, which
        depends on the directions in which the stars lie.
        """
        across, about = np.diag(self.covariance)[:2].mean(), self.covariance[2, 2]
        ring = np.column_stack([np.sqrt(across / about) * CIRCLE, np.ones(len(CIRCLE))])
        true = rotation.normalised(ring) @ self.camera_to_itrs.T
        apparent = rotation.normalised(true + station_velocity(zenith))
        level = rotation.shortest_turn(zenith, np.array([0.0, 0.0, 1.0]))
        seen = atmosphere.refraction().bend(apparent @ level.T) @ level
        camera = rotation.best_rotation(true, seen) @ self.camera_to_itrs
        raised = rotation.to_small_vector(rotation.best_rotation(apparent, seen))
        height = max(float(seen.mean(0) @ zenith), LOWEST)
        squeezed = float(np.linalg.norm(raised)) * np.sqrt(1 - min(height, 1.0) ** 2) / height
        uneven = squeezed * np.array([OFF_AXIS, OFF_AXIS, SPREAD])
        return StarAttitude(
            camera_to_itrs=camera,
            covariance=self.covariance + np.diag(uneven**2),
            by_refraction=camera.T @ raised,
        )

# SPDX-License-Identifier: Apache-2.0
"""What is known of instrument and vehicle before a voyage."""

from dataclasses import dataclass

import numpy as np

from starpos.earth.refraction import Atmosphere
from starpos.navigation.imu import ImuModel
from starpos.navigation.laws import ANYTHING, LAWS, MotionLaw

PARKED, ROVER = "parked", "rover"


@dataclass(frozen=True, eq=False, kw_only=True)
class Vessel:
    """An instrument on a vehicle.

    vehicle: a name in LAWS, or None for anything.  model: of the IMU.
    camera_to_body (3, 3), mount_stddev: as believed, and rad an axis.  clock_stddev_s: of the stamps against UTC.
    drift_stddev: m/s an axis, of water or air against the ground, where velocities are measured against these.
    height_m, height_stddev_m: above the ellipsoid; by itself anywhere on land.
    """

    vehicle: str | None
    model: ImuModel
    camera_to_body: np.ndarray
    mount_stddev: float
    atmosphere: Atmosphere
    clock_stddev_s: float
    drift_stddev: float = 0.0
    height_m: float = 500.0
    height_stddev_m: float = 2000.0

    @property
    def law(self) -> MotionLaw:
        """How its speed changes where nothing measures it."""
        return ANYTHING if self.vehicle is None else LAWS[self.vehicle]

    @property
    def parked(self) -> bool:
        """Whether it stands all the time."""
        return self.vehicle == PARKED

    @property
    def halts(self) -> bool:
        """Whether it may stand on the ground now and then."""
        return self.vehicle == ROVER

# SPDX-License-Identifier: Apache-2.0
"""What is known of instrument and vehicle before a voyage."""

import math
from dataclasses import dataclass

import numpy as np

from starpos.earth.refraction import Atmosphere
from starpos.errors import VoyageError
from starpos.navigation.imu import ImuModel
from starpos.navigation.laws import ANYTHING, LAWS, MotionLaw, carried, drifting

PARKED, ROVER = "parked", "rover"


@dataclass(frozen=True, eq=False, kw_only=True)
class Vessel:
    """An instrument on a vehicle; VoyageError for a drift that it cannot have.

    vehicle: a name in LAWS, or None for anything.  model: of the IMU.
    camera_to_body (3, 3), mount_stddev: as believed, and rad an axis.  clock_stddev_s: of the stamps against UTC.
    drift_stddev: m/s an axis, of water or air against the ground, where velocities are measured against these.
    drift_change: m/s an axis, 1 sigma, by which water or air change in ten minutes; NaN: as the law has it.
    height_m, height_stddev_m: above the ellipsoid; by itself anywhere on land.
    """

    vehicle: str | None
    model: ImuModel
    camera_to_body: np.ndarray
    mount_stddev: float
    atmosphere: Atmosphere
    clock_stddev_s: float
    drift_stddev: float = 0.0
    drift_change: float = math.nan
    height_m: float = 500.0
    height_stddev_m: float = 2000.0

    def __post_init__(self) -> None:
        check_drift(self.vehicle, self.drift_stddev, self.drift_change)

    @property
    def law(self) -> MotionLaw:
        """How its speed changes where nothing measures it."""
        return self._drifting(ANYTHING if self.vehicle is None else LAWS[self.vehicle])

    @property
    def carried(self) -> MotionLaw:
        """How the drift changes where velocities are measured against water or air."""
        return self._drifting(carried(self.drift_stddev))

    def _drifting(self, law: MotionLaw) -> MotionLaw:
        return law if math.isnan(self.drift_change) else drifting(law, self.drift_change)

    @property
    def parked(self) -> bool:
        """Whether it stands all the time."""
        return self.vehicle == PARKED

    @property
    def halts(self) -> bool:
        """Whether it may stand on the ground now and then."""
        return self.vehicle == ROVER


def check_drift(vehicle: str | None, drift_stddev: float, drift_change: float) -> None:
    """Raise VoyageError if it cannot be so, as of a vehicle that has no drift."""
    if math.isnan(drift_change):
        return
    if not 0 < drift_change < math.inf:
        raise VoyageError(f"drift change {drift_change:g} m/s: it must be a finite number above 0")
    if vehicle in (PARKED, ROVER) and not drift_stddev:
        raise VoyageError(
            f"drift change {drift_change:g} m/s: it is of wind or current, and neither carries a vehicle that is "
            f"'{vehicle}'"
        )

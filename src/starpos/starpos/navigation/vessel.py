# SPDX-License-Identifier: Apache-2.0
"""What is known of instrument and vehicle before a voyage, with the laws of motion where nothing measures the speed."""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from starpos.earth.refraction import Atmosphere
from starpos.fix.sighting import Sighting
from starpos.navigation.records import ImuModel
from starpos.tables import packaged


@dataclass(frozen=True, kw_only=True)
class MotionLaw:
    """Velocity of a vehicle over ground as a speed along its nose, a drift, and a rest; m/s, 1 sigma.

    speed_stddev, speed_walk: of the speed along the nose, level, at the start, and its change in m/s/sqrt(s)
    drift_stddev, drift_walk: an axis of what carries the vehicle along (wind, current), level, likewise
    rest_stddev, climb_stddev: of what is left, level an axis, and of climbing, which is 0 in the mean
    rest_s: so long either keeps its sign
    """

    speed_stddev: float
    speed_walk: float
    drift_stddev: float
    drift_walk: float
    rest_stddev: float
    climb_stddev: float
    rest_s: float

    def longer(self, apart_s: float) -> float:
        """Factor on the rest, or on climbing, at times so far apart, where it is taken for white noise.

        In the long run that scatters as what keeps its sign.
        """
        return max(1.0, 2 * self.rest_s / apart_s) ** 0.5


LAWS = {
    row.pop("vehicle"): MotionLaw(**{name: float(value) for name, value in row.items()})
    for row in packaged("starpos.navigation", "laws.csv")
}
ANYTHING = LAWS.pop("anything")
# of a drift such a share changes in an hour
DRIFT_CHANGE, DRIFT_CHANGE_S = 0.5, 3600.0


# stands all the time; may stand on the ground now and then
PARKED, ROVER = "parked", "rover"


@dataclass(frozen=True, eq=False, kw_only=True)
class Vessel:
    """An instrument on a vehicle.

    vehicle: a name in LAWS, or None for anything.  model: of the IMU.
    camera_to_body (3, 3), mount_stddev: as believed, and rad an axis.
    clock_stddev_s: of the stamps against UTC, at least; a frame may state that its clock is worse.
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

    def law(self, measured: bool) -> MotionLaw | None:
        """How speed and drift change; measured: whether velocities are. None where the velocity over ground is known."""
        if measured and self.drift_stddev > 0:
            # of the water or air against which they are measured
            walk = DRIFT_CHANGE * self.drift_stddev / DRIFT_CHANGE_S**0.5
            return replace(LAWS[PARKED], drift_stddev=self.drift_stddev, drift_walk=walk)
        if measured or self.vehicle == PARKED:
            return None
        return ANYTHING if self.vehicle is None else LAWS[self.vehicle]

    def clock_stddev_of(self, frames: Iterable[Sighting]) -> float:
        """The error (s, 1 sigma) of the clock that stamped these frames, which they share."""
        return max(self.clock_stddev_s, *(f.clock_stddev_s for f in frames))

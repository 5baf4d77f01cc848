# SPDX-License-Identifier: Apache-2.0
"""What is known of instrument and vehicle before a voyage, with the laws of motion where nothing measures the speed."""

from dataclasses import dataclass, fields

import numpy as np

from starpos.earth.refraction import Atmosphere
from starpos.navigation.records import ImuModel


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


def _law(*row: float) -> MotionLaw:
    """The law with the fields of a row, in their order."""
    return MotionLaw(**{f.name: value for f, value in zip(fields(MotionLaw), row, strict=True)})


LAWS = {
    name: _law(*row)
    for name, row in {
        # a path at a walk, that turns and stops as it likes
        "rover": (2.0, 0.3, 0.01, 1e-4, 0.1, 0.2, 3.0),
        # under way, in waves of seconds, in a current that is steady over an hour
        "ship": (10.0, 0.05, 1.0, 0.003, 0.7, 0.7, 3.0),
        # a steady airspeed in a wind that changes by 0.3 m/s in ten minutes; gusts of seconds
        "drone": (50.0, 0.1, 15.0, 0.012, 0.8, 0.8, 4.0),
        "parked": (1e-3, 1e-6, 1e-3, 1e-6, 2e-3, 2e-3, 1.0),
    }.items()
}
# default: any vehicle on land, at sea or in the air
ANYTHING = _law(100.0, 1.0, 30.0, 0.3, 5.0, 3.0, 10.0)
# of a drift such a share changes in an hour
DRIFT_CHANGE, DRIFT_CHANGE_S = 0.5, 3600.0


# stands all the time; may stand on the ground now and then
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
    def carried(self) -> MotionLaw:
        """How the drift changes where velocities are measured against water or air."""
        walk = DRIFT_CHANGE * self.drift_stddev / DRIFT_CHANGE_S**0.5
        return _law(1e-3, 1e-6, self.drift_stddev, walk, 1e-3, 1e-3, 1.0)

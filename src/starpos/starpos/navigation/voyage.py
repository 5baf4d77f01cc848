# SPDX-License-Identifier: Apache-2.0
"""Place, heading and velocity of a recorded voyage, from all its stars, inertial readings and velocities at once."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from starpos.earth.ellipsoid import curvature_radii_m, enu_axes, meridian_turn
from starpos.earth.gravity import geodetic_place
from starpos.earth.orientation import earth_state
from starpos.errors import VoyageError
from starpos.fix.budget import heading_of, heading_row, time_terms, total_covariance
from starpos.navigation.adjustment import FEWEST_FRAMES, Adjustment
from starpos.navigation.chain import Smoothed
from starpos.navigation.imu import ImuLog
from starpos.navigation.motion import PLACE, TURN, Motion
from starpos.navigation.preintegration import Pieces
from starpos.navigation.sightings import IdentifiedFrame
from starpos.navigation.start import nodes_of
from starpos.navigation.velocity import VelocityLog
from starpos.navigation.vessel import Vessel
from starpos.progress import Progress, quiet

MOST_APART_S = 1.5


@dataclass(frozen=True, eq=False, kw_only=True)
class VoyageFix:
    """Astronomic latitude, longitude and heading of the body's x (rad) at one time of a voyage.

    covariance (3, 3): east m, north m, heading rad.  velocity (3,): east, north, up, m/s.
    gyro_bias, accel_bias (3,): rad/s, m/s2.
    """

    utc_unix_s: float
    latitude: float
    longitude: float
    heading: float
    covariance: np.ndarray
    velocity: np.ndarray
    gyro_bias: np.ndarray
    accel_bias: np.ndarray


@dataclass(frozen=True, eq=False, kw_only=True)
class Voyage:
    """Fixes at the times that were asked for, None where there is no answer.

    faults: what is wrong with the record, in sentences.  excess, left_out: of frames and velocities, as `Adjustment` has
    them.  rounds: of the adjustment; motion, solution: its last.
    """

    fixes: tuple[VoyageFix | None, ...]
    faults: tuple[str, ...]
    excess: dict[str, float]
    left_out: dict[str, int]
    rounds: int
    motion: Motion
    solution: Smoothed


def navigate(
    frames: Sequence[IdentifiedFrame],
    imu: ImuLog,
    velocity: VelocityLog | None,
    vessel: Vessel,
    times: np.ndarray | None = None,
    progress: Progress = quiet,
) -> Voyage:
    """Fixes at times (T,), Unix s, or those of the frames; VoyageError or FixError says why there are none.

    Nothing need be known of the start.  The place is where gravity points, astronomic.
    """
    times = np.array([f.utc_unix_s for f in frames]) if times is None else np.asarray(times, float)
    begin, end = imu.utc_unix_s[0] - imu.length_s[0], imu.utc_unix_s[-1]
    within = sorted((f for f in frames if begin <= f.utc_unix_s <= end), key=lambda f: f.utc_unix_s)
    if len({f.utc_unix_s for f in within}) < FEWEST_FRAMES:
        raise VoyageError(
            f"{len(within)} frames with stars have inertial readings at their times: at least {FEWEST_FRAMES} are "
            "needed; check that the clocks of camera and IMU agree"
        )
    inside = (times >= begin) & (times <= end)
    asked = np.concatenate([times[inside], [f.utc_unix_s for f in within]])
    nodes = nodes_of(np.unique(asked), MOST_APART_S)
    adjustment = Adjustment(within, nodes, Pieces.cut(imu, nodes), velocity, vessel, imu.vibration)
    motion, solution, rounds = adjustment.settle(progress)
    stamp_s = float(np.median([f.stamp_stddev_s for f in within]))
    return Voyage(
        fixes=tuple(
            fix_at(motion, solution, k, vessel.clock_stddev_s, stamp_s) if there else None
            for k, there in zip(np.searchsorted(nodes, times), inside, strict=True)
        ),
        faults=(*imu.faults, *(() if velocity is None else velocity.faults), *adjustment.faults),
        excess=adjustment.excess,
        left_out=adjustment.left_out,
        rounds=rounds,
        motion=motion,
        solution=solution,
    )


def fix_at(
    motion: Motion, solution: Smoothed, k: int, clock_stddev_s: float, stamp_stddev_s: float
) -> VoyageFix:
    """The fix at node k; the errors of clock and Earth rotation, which all fixes share, are added to its covariance."""
    latitude, longitude, _ = (float(x) for x in geodetic_place(motion.place[k]))
    enu, (prime, meridian) = enu_axes(latitude, longitude), curvature_radii_m(latitude)
    attitude = enu @ motion.attitude[k]
    # turns of east, north, up about themselves for a metre to the east and to the north
    carried = np.array([[0, -1 / meridian], [1 / prime, 0], [meridian_turn(latitude) / prime, 0]])
    slope = np.zeros((3, 6))
    slope[:2, :3] = enu[:2]
    slope[2:, :3] = -heading_row(np.eye(3), attitude) @ carried @ enu[:2]
    slope[2:, 3:] = heading_row(enu, attitude)
    columns = np.r_[PLACE, TURN]
    covariance = slope @ solution.covariance[k][np.ix_(columns, columns)] @ slope.T
    earth = earth_state(float(motion.utc_unix_s[k]))
    terms = time_terms(latitude, earth, clock_stddev_s, stamp_stddev_s)
    return VoyageFix(
        utc_unix_s=float(motion.utc_unix_s[k]),
        latitude=latitude,
        longitude=longitude,
        heading=heading_of(attitude),
        covariance=covariance + total_covariance(terms)[:3, :3],
        velocity=enu @ motion.velocity[k],
        gyro_bias=motion.gyro_bias[k],
        accel_bias=motion.accel_bias[k],
    )

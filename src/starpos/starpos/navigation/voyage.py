# SPDX-License-Identifier: Apache-2.0
"""Place, heading and velocity of a recorded voyage, from all its stars, inertial readings and velocities at once."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from starpos.errors import VoyageError
from starpos.navigation.adjustment import MIN_FRAMES, Adjustment
from starpos.navigation.chain import Smoothed
from starpos.navigation.estimate import Estimate
from starpos.navigation.imu import ImuLog
from starpos.navigation.motion import Motion
from starpos.navigation.preintegration import Pieces
from starpos.navigation.sightings import FrameUnderWay
from starpos.navigation.start import nodes_of
from starpos.navigation.velocity import VelocityLog
from starpos.navigation.vessel import Vessel
from starpos.navigation.voyage_fix import TimeErrors, VoyageFix, fix_of
from starpos.progress import Progress, quiet

MAX_APART_S = 1.5


@dataclass(frozen=True, eq=False, kw_only=True)
class Voyage:
    """Fixes at the times that were asked for, None where there is no answer.

    faults: what is wrong with the record, in sentences.  excess, left_out: of frames and velocities, as `Adjustment` has
    them.  rounds: of the adjustment; motion, solution: its last.  last: where it ends, to be carried on.
    """

    fixes: tuple[VoyageFix | None, ...]
    faults: tuple[str, ...]
    excess: dict[str, float]
    left_out: dict[str, int]
    rounds: int
    motion: Motion
    solution: Smoothed
    last: Estimate


def navigate(
    frames: Sequence[FrameUnderWay],
    imu: ImuLog,
    velocity: VelocityLog | None,
    vessel: Vessel,
    times: np.ndarray | None = None,
    progress: Progress = quiet,
) -> Voyage:
    """Fixes at times (T,), Unix s, or at the frames' times; VoyageError or FixError if there is no fix.

    No prior knowledge of the start is needed.  The place is where gravity points, astronomic.
    """
    times = np.array([f.utc_unix_s for f in frames]) if times is None else np.asarray(times, float)
    begin, end = imu.utc_unix_s[0] - imu.length_s[0], imu.utc_unix_s[-1]
    within = sorted((f for f in frames if begin <= f.utc_unix_s <= end), key=lambda f: f.utc_unix_s)
    if len({f.utc_unix_s for f in within}) < MIN_FRAMES:
        raise VoyageError(
            f"{len(within)} frames with stars have inertial readings at their times: at least {MIN_FRAMES} are "
            "needed; check that the clocks of camera and IMU agree"
        )
    inside = (times >= begin) & (times <= end)
    asked = np.concatenate([times[inside], [f.utc_unix_s for f in within]])
    nodes = nodes_of(np.unique(asked), MAX_APART_S)
    adjustment = Adjustment(within, nodes, Pieces.cut(imu, nodes), velocity, vessel, imu.vibration)
    motion, solution, rounds = adjustment.settle(progress)
    stamp_s = float(np.median([f.stamp_stddev_s for f in within]))
    errors = TimeErrors(clock_s=vessel.clock_stddev_s, stamp_s=stamp_s)
    return Voyage(
        fixes=tuple(
            fix_of(motion, k, solution.covariance[k], errors) if there else None
            for k, there in zip(np.searchsorted(nodes, times), inside, strict=True)
        ),
        faults=(*imu.faults, *(() if velocity is None else velocity.faults), *adjustment.faults),
        excess=adjustment.excess,
        left_out=adjustment.left_out,
        rounds=rounds,
        motion=motion,
        solution=solution,
        last=Estimate(
            motion=motion.part(np.array([-1])),
            covariance=solution.covariance[-1],
            model=adjustment.model,
            law=adjustment.law,
            errors=errors,
        ),
    )

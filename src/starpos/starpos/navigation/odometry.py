# SPDX-License-Identifier: Apache-2.0
"""Measured velocities against a voyage's velocities: the residuals, at the nearest nodes."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from starpos.earth.gravity import SPIN, gravity
from starpos.navigation.measures import Lacks, velocity_lacks
from starpos.navigation.motion import Motion
from starpos.navigation.preintegration import Pieces, Sums
from starpos.navigation.velocity import VelocityLog
from starpos.normal import SIGMA_PER_MAD

# velocities farther off come from a slipping wheel or another mishap
OUTLIER_SIGMA = 5.0


@dataclass(frozen=True, eq=False, kw_only=True)
class Odometry:
    """N velocities of a log that lie on a voyage: the interval (N,) and the node (N,) of each.

    offset_s (N,): since the interval's begin.  piece (N,): of the interval's readings.
    """

    velocity: np.ndarray
    sigma: np.ndarray
    interval: np.ndarray
    offset_s: np.ndarray
    piece: np.ndarray
    node: np.ndarray

    @classmethod
    def of(cls, log: VelocityLog, nodes: np.ndarray, pieces: Pieces) -> "Odometry":
        """Find where the velocities of a log lie among nodes (K,), Unix s."""
        on = (log.utc_unix_s >= nodes[0]) & (log.utc_unix_s <= nodes[-1])
        t = log.utc_unix_s[on]
        interval = np.clip(np.searchsorted(nodes, t, "right") - 1, 0, len(nodes) - 2)
        offset = t - nodes[interval]
        there = pieces.length_s > 0
        first = np.cumsum(there.sum(1)) - there.sum(1)
        begins = (pieces.begin_s + (nodes[:-1] - nodes[0])[:, None])[there]
        piece = np.searchsorted(begins, t - nodes[0], "right") - 1 - first[interval]
        return cls(
            velocity=log.velocity[on],
            sigma=log.sigma[on],
            interval=interval,
            offset_s=offset,
            piece=np.clip(piece, 0, there.shape[1] - 1),
            node=interval + (offset > pieces.span_s[interval] / 2),
        )

    def missed(self, motion: Motion, sums: Sums, pieces: Pieces) -> np.ndarray:
        """Measured less predicted velocities (N, 3), along the body's axes."""
        k, s = self.interval, self.piece
        since = (self.offset_s - pieces.begin_s[k, s])[:, None]
        turned = sums.turns[k, s] @ Rotation.from_rotvec(sums.rates[k, s] * since).as_matrix()
        force = pieces.force[k, s] - motion.accel_bias[k]
        speed = sums.speeds[k, s] + np.einsum("kij,kj->ki", turned, force) * since
        falling = gravity(motion.place[k]) - 2 * np.cross(SPIN, motion.velocity[k])
        velocity = np.einsum("kij,kj->ki", motion.attitude[k], speed) + falling * self.offset_s[:, None]
        attitude = motion.attitude[k] @ turned
        forward = np.einsum("kji,kj->ki", attitude, motion.velocity[k] + velocity - motion.drift[k])
        return self.velocity - (1 + motion.log_scale) * (forward + np.cross(motion.log_axes, forward))

    def lacks(self, motion: Motion, missed: np.ndarray, keep: np.ndarray, vibration: float, n: int) -> Lacks:
        """Equations of the nodes near velocities to keep (N,), of which missed (N, 3) are measured less predicted."""
        weight = keep / self.sigma**2
        total = np.bincount(self.node, weight, len(motion))
        index = np.flatnonzero(total)
        mean = np.stack([np.bincount(self.node, weight * part, len(motion)) for part in missed.T], -1)[index]
        sigma = np.hypot(1 / np.sqrt(total[index]), vibration)
        return velocity_lacks(motion, index, mean / total[index, None], sigma, n)

    def sound(self, missed: np.ndarray) -> np.ndarray:
        """Mask (N,) of the velocities that do not lie beyond what most of them scatter, or should."""
        size = np.abs(missed).max(1) / self.sigma
        usual = max(1.0, SIGMA_PER_MAD * float(np.median(np.abs(missed) / self.sigma[:, None])))
        return size < OUTLIER_SIGMA * usual

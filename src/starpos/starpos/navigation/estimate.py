# SPDX-License-Identifier: Apache-2.0
"""What is known at one time of a voyage, carried on by the inertial readings that come after it."""

from dataclasses import dataclass, fields, replace
from typing import TypeVar

import numpy as np

from starpos.navigation.imu import ImuLog, ImuModel
from starpos.navigation.laws import MotionLaw
from starpos.navigation.links import arrived, links_of
from starpos.navigation.motion import CONSTANTS, Motion
from starpos.navigation.preintegration import Pieces, Sums, summed
from starpos.navigation.start import nodes_of
from starpos.navigation.voyage_fix import TimeErrors, VoyageFix, fix_of

# the equations of a link hold for so long
LONGEST_S = 1.5
T = TypeVar("T", Pieces, Sums)


@dataclass(frozen=True, eq=False, kw_only=True)
class Estimate:
    """A motion of one node, and the covariance (n + m, n + m) of its unknowns with the constants.

    model: of the IMU, its noise as the voyage shows it.  law: whose unknowns the node has, if any.
    """

    motion: Motion
    covariance: np.ndarray
    model: ImuModel
    law: MotionLaw | None
    errors: TimeErrors

    @property
    def utc_unix_s(self) -> float:
        return float(self.motion.utc_unix_s[0])

    @property
    def unknowns(self) -> int:
        """Unknowns n of the node."""
        return len(self.covariance) - CONSTANTS

    @property
    def fix(self) -> VoyageFix:
        return fix_of(self.motion, 0, self.covariance, self.errors)

    def carried_on(self, imu: ImuLog, until_s: float) -> "Estimate":
        """The estimate at a time after its own, by the readings until then; what is missing of them widens it."""
        nodes = nodes_of(np.array([self.utc_unix_s, until_s]), LONGEST_S)
        pieces = Pieces.cut(imu, nodes)
        motion, covariance = self.motion, self.covariance
        count = len(nodes) - 1
        gyro_bias, accel_bias = (np.tile(b, (count, 1)) for b in (motion.gyro_bias, motion.accel_bias))
        sums = summed(pieces, gyro_bias, accel_bias, motion.gyro_matrix, motion.accel_matrix)
        for k in range(count):
            motion, covariance = self._next(motion, covariance, _part(sums, k), _part(pieces, k))
        return replace(self, motion=motion, covariance=covariance)

    def _next(
        self, here: Motion, covariance: np.ndarray, sums: Sums, pieces: Pieces
    ) -> tuple[Motion, np.ndarray]:
        both = here.part(np.zeros(2, int))
        both.utc_unix_s[1:] += pieces.span_s
        links = links_of(both, sums, pieces, self.model, self.law)
        n = links.rows.shape[1]
        onward = np.eye(len(covariance))
        onward[:n, :n], onward[:n, n:] = -links.rows[0, :, :n], -links.rows[0, :, 2 * n : -1]
        there = arrived(both, sums, pieces.span_s)
        after = onward @ covariance @ onward.T
        after[:n, :n] += links.covariance[0]
        moved = replace(
            both.part(np.ones(1, int)), attitude=there.attitude, place=there.place, velocity=there.velocity
        )
        return moved, after


def _part(table: T, k: int) -> T:
    """Interval k alone."""
    return type(table)(**{f.name: getattr(table, f.name)[k : k + 1] for f in fields(table)})

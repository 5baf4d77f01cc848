# SPDX-License-Identifier: Apache-2.0
"""What is known at one time of a voyage: its fix, how later readings carry it on, and what would improve it."""

from dataclasses import dataclass, replace

import numpy as np

from starpos._numeric.roots import symmetric_root
from starpos.earth.ellipsoid import curvature_radii_m, enu_axes, meridian_turn
from starpos.earth.gravity import enu_at, geodetic_place
from starpos.earth.orientation import earth_state
from starpos.fix.attitude import ENU, LINK, Attitude, heading_of, heading_row
from starpos.fix.budget import time_terms
from starpos.fix.fix import PlaceFix
from starpos.fix.terms import ErrorTerm, total_covariance
from starpos.frozen import at_once
from starpos.navigation.equations import (
    ACCEL_BIAS,
    BY_LAW,
    CONSTANTS,
    DRIFT,
    MOUNT,
    PLACE,
    SPEED,
    TURN,
    VELOCITY,
    Motion,
    arrived,
    links_of,
    sums_of,
)
from starpos.navigation.preintegration import Pieces
from starpos.navigation.records import ImuLog, ImuModel
from starpos.navigation.start import nodes_of
from starpos.navigation.vessel import MotionLaw


@at_once
@dataclass(frozen=True, kw_only=True)
class VoyageFix(PlaceFix):
    """Astronomic latitude, longitude and heading of the body's x (rad) at one time of a voyage.

    Attributes
    ----------
    velocity, velocity_covariance : (3,) east, north, up, m/s, and (3, 3)
    link : the body's axes, x forward, into east, north, up
    gyro_bias, accel_bias : (3,) rad/s, m/s2

    Examples
    --------
    >>> lists = sorted(Path("drive").glob("stars_*.csv"))
    >>> voyage = starpos.navigate(lists, "drive/imu.csv", starpos.Instrument(4635.9375), vehicle="rover")
    >>> voyage.fixes[-1].velocity.shape
    (3,)
    """

    velocity: np.ndarray
    velocity_covariance: np.ndarray
    link: Attitude
    gyro_bias: np.ndarray
    accel_bias: np.ndarray


@dataclass(frozen=True, eq=False, kw_only=True)
class Estimate:
    """A motion of one node, and the covariance (n + m, n + m) of its unknowns with the constants.

    model: of the IMU, its noise as the voyage shows it.  law: whose unknowns the node has, if any.
    clock_stddev_s, stamp_stddev_s: errors of time that all fixes share, of the clock and of the frames' stamps.
    """

    motion: Motion
    covariance: np.ndarray
    model: ImuModel
    law: MotionLaw | None
    clock_stddev_s: float
    stamp_stddev_s: float

    @property
    def utc_unix_s(self) -> float:
        return float(self.motion.utc_unix_s[0])

    @property
    def unknowns(self) -> int:
        """Unknowns n of the node."""
        return len(self.covariance) - CONSTANTS

    @property
    def fix(self) -> VoyageFix:
        """The fix; the errors of time and of the Earth's rotation are added."""
        motion, covariance = self.motion, self.covariance
        latitude, longitude, _ = (float(x) for x in geodetic_place(motion.place[0]))
        enu, (prime, meridian) = enu_axes(latitude, longitude), curvature_radii_m(latitude)
        attitude = enu @ motion.attitude[0]
        # turns of east, north, up about themselves for a metre to the east and to the north
        carried = np.array([[0, -1 / meridian], [1 / prime, 0], [meridian_turn(latitude) / prime, 0]])
        # rows of an ErrorTerm, by place and attitude in ITRS
        slope = np.zeros((6, 6))
        slope[:2, :3] = enu[:2]
        slope[3:, :3] = -carried @ enu[:2]
        slope[3:, 3:] = enu
        slope[2] = heading_row(attitude) @ slope[3:]
        columns = np.r_[PLACE, TURN]
        own = ErrorTerm("adjustment", slope @ symmetric_root(covariance[np.ix_(columns, columns)]))
        earth = earth_state(self.utc_unix_s)
        terms = own, *time_terms(latitude, earth, self.clock_stddev_s, self.stamp_stddev_s)
        return VoyageFix(
            utc_unix_s=self.utc_unix_s,
            latitude=latitude,
            longitude=longitude,
            heading=heading_of(attitude),
            terms=terms,
            velocity=enu @ motion.velocity[0],
            velocity_covariance=enu @ covariance[VELOCITY, VELOCITY] @ enu.T,
            link=Attitude(attitude, total_covariance(terms)[3:, 3:], of=LINK, into=ENU),
            gyro_bias=motion.gyro_bias[0],
            accel_bias=motion.accel_bias[0],
        )

    def carried_on(self, imu: ImuLog, until_s: float) -> "Estimate":
        """The estimate at a time after its own, by the readings until then; what is missing of them widens it."""
        there = self
        for time_s in nodes_of(np.array([self.utc_unix_s, until_s]))[1:]:
            there = there._next(imu, time_s)
        return there

    def _next(self, imu: ImuLog, time_s: float) -> "Estimate":
        both = self.motion.part(np.zeros(2, int))
        both.utc_unix_s[1] = time_s
        pieces = Pieces.cut(imu, both.utc_unix_s)
        sums = sums_of(pieces, both)
        links = links_of(both, sums, pieces, self.model, self.law)
        n = self.unknowns
        onward = np.eye(len(self.covariance))
        onward[:n, :n], onward[:n, n:] = -links.rows[0, :, :n], -links.rows[0, :, 2 * n : -1]
        after = onward @ self.covariance @ onward.T
        after[:n, :n] += links.covariance[0]
        return replace(self, motion=arrived(both, sums, pieces.span_s), covariance=after)


# a claim of less needs no advice, m an axis
ENOUGH_M = 200.0
# an unknown counts by which at least this share of the error comes
SHARE = 0.5
BIAS, CAMERA, MOTION, WHOLE = (
    "turn once: the accelerometer's bias is not known",
    "turn once: how the camera sits on the IMU is not known",
    "measure the velocity: how it changes is not known",
    "go on and turn: the longer the record, the narrower the claim",
)


def observability(estimate: Estimate, measured: bool) -> tuple[float, str]:
    """1 sigma of the place, m an axis, and a sentence on what is missing, '' where nothing is.

    That is the unknown which the place depends on most: by how much its error would shrink if it were known.
    measured: whether a velocity is measured, so that nothing else would determine it.
    """
    covariance = estimate.covariance
    level = enu_at(estimate.motion.place[0])[:2]
    place = level @ covariance[PLACE, PLACE] @ level.T
    sigma_m = float(np.sqrt(np.trace(place) / 2))
    if sigma_m < ENOUGH_M:
        return sigma_m, ""
    n = estimate.unknowns
    speed = np.r_[VELOCITY, SPEED, DRIFT] if n == BY_LAW else np.r_[VELOCITY]
    groups = {BIAS: np.r_[ACCEL_BIAS], CAMERA: n + np.r_[MOUNT]} | ({} if measured else {MOTION: speed})
    share = {}
    for sentence, columns in groups.items():
        across = level @ covariance[PLACE, columns]
        told = across @ np.linalg.pinv(covariance[np.ix_(columns, columns)]) @ across.T
        share[sentence] = float(np.trace(told) / np.trace(place))
    most = max(share, key=lambda sentence: share[sentence])
    return sigma_m, most if share[most] > SHARE else WHOLE

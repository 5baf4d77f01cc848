# SPDX-License-Identifier: Apache-2.0
"""Tilts from accelerations: averages of an accelerometer at rest, their covariance, and what is no tilt."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from starpos_common.parameters import Parameter
from starpos_inclinometer.noise import NoiseTracker
from starpos_inclinometer.sources.reading import GAP, STUCK, Reading

# m/s2; true within 0.3 % everywhere on the ground
STANDARD_GRAVITY = 9.80665
# An average needs so many readings: fewer show no scatter.
LEAST = 3
# Share of the time of an average that its readings must cover.
COVERED = 0.5
# If stamps go back further than this, the clock was set.
NEW_TIME_S = 1.0
# A floor, for a simulated accelerometer may have no noise.
LEAST_STDDEV_RAD = 1e-6
# Most readings in an average.
MAX_MESSAGES = 10_000

FORCE_PARAMETERS = (
    Parameter(
        "imu.average",
        0.5,
        "Time over which accelerations are averaged to one tilt, of sources imu and iio; short ones are noisy, long "
        "ones late.",
        unit="s",
        minimum=0.02,
        maximum=60.0,
    ),
    Parameter(
        "imu.max_force_error",
        0.05,
        "Share by which the acceleration may differ from 9.81 m/s2; beyond it is not at rest and tells no tilt. "
        "Too small refuses an uncalibrated accelerometer, too large takes driving for leaning.",
        unit="",
        minimum=0.0001,
        maximum=0.5,
    ),
)


@dataclass(frozen=True, slots=True)
class Felt:
    """An accelerometer's reading, at rest or not."""

    stamp_ns: int
    # Specific force, m/s2.
    force: tuple[float, float, float]
    # rad/s; 0 if it is not measured.
    rotation: float
    # In m2/s4, of each axis; 0 where it is not stated.
    variance: tuple[float, float, float]


@dataclass(frozen=True)
class MeanForce:
    """The readings of one span of time; forces is (N, 3), see `Felt`."""

    forces: np.ndarray
    mid_ns: int
    # Root mean square, rad/s.
    rotation: float
    # (3,) m2/s4, as stated for one message.
    variance: np.ndarray

    @classmethod
    def of(cls, messages: list[Felt]) -> "MeanForce":
        return cls(
            np.array([m.force for m in messages]),
            (messages[0].stamp_ns + messages[-1].stamp_ns) // 2,
            math.sqrt(sum(m.rotation**2 for m in messages) / len(messages)),
            np.mean([m.variance for m in messages], axis=0),
        )

    @property
    def force(self) -> np.ndarray:
        return self.forces.mean(0)

    def unrest(self, max_force_error: float, max_rotation: float) -> str:
        """Say why it gives no tilt (limits: a share of g, rad/s); empty if it gives one."""
        strength = float(np.linalg.norm(self.force))
        if abs(strength / STANDARD_GRAVITY - 1) > max_force_error:
            return f"it feels {strength:.3g} m/s2 where gravity is 9.81"
        if self.rotation > max_rotation:
            return f"it turns at {math.degrees(self.rotation):.2g} deg/s"
        return ""

    def tilt(self) -> tuple[float, float, float]:
        """Elevations of x, y and z, rad."""
        x, y, z = np.arcsin(np.clip(self.force / np.linalg.norm(self.force), -1, 1)).tolist()
        return x, y, z

    def covariance(self) -> np.ndarray:
        """Covariance of the tilt, (3, 3) rad2, from the scatter of the forces, or the stated variance if that is more."""
        scatter = np.cov(self.forces, rowvar=False)
        more = np.sqrt(np.maximum(self.variance, np.diag(scatter)))
        stddev = np.sqrt(np.diag(scatter))
        grown = np.divide(more, stddev, out=np.ones(3), where=stddev > 0)
        forces = scatter * np.outer(grown, grown) + np.diag(np.where(stddev > 0, 0.0, self.variance))
        strength = np.linalg.norm(self.force)
        up = self.force / strength
        # d asin(u) = du / cos, du = (1 - u u^T) df / |f|
        slope = (np.eye(3) - np.outer(up, up)) / strength
        slope /= np.sqrt(np.maximum(1 - up**2, 0.01))[:, None]
        return slope @ forces @ slope.T / len(self.forces) + LEAST_STDDEV_RAD**2 * np.eye(3)


class ForceAverager:
    """Averages messages over a given time, in the order of their stamps; counts the messages it drops."""

    def __init__(self, seconds: float) -> None:
        self.seconds = seconds
        self.duplicates = self.disordered = 0
        # How often the sequence of averages was interrupted.
        self.breaks = 0
        self._messages: list[Felt] = []
        self._last_ns = 0

    def add(self, message: Felt) -> MeanForce | None:
        """Take a message; return the average that it ends, if it ends one that has enough messages."""
        last_ns, messages = self._last_ns, self._messages
        if message.stamp_ns == last_ns:
            self.duplicates += 1
            return None
        if message.stamp_ns < last_ns:
            if last_ns - message.stamp_ns < NEW_TIME_S * 1e9:
                self.disordered += 1
                return None
            messages = []
        length_ns = self.seconds * 1e9
        self.breaks += bool(last_ns) and not 0 < message.stamp_ns - last_ns <= length_ns
        self._last_ns = message.stamp_ns
        if messages and message.stamp_ns - messages[0].stamp_ns < length_ns and len(messages) < MAX_MESSAGES:
            messages.append(message)
            return None
        self._messages = [message]
        if len(messages) < LEAST or messages[-1].stamp_ns - messages[0].stamp_ns < COVERED * length_ns:
            self.breaks += bool(messages)
            return None
        return MeanForce.of(messages)


class ForceTilts:
    """Tilts of one accelerometer: averages that are at rest, with flags, numbers, and a covariance."""

    def __init__(self, values: Mapping[str, Any]) -> None:
        self.averager = ForceAverager(values["imu.average"])
        self.noise = NoiseTracker()
        # Why the last average gave no tilt; empty if it gave one.
        self.unrest = ""
        # rad/s; of a sensor without a gyroscope it does not matter.
        self.max_rotation = math.inf
        self._sequence = 0
        self._gap = self._has_noise = False
        self.configure(values)

    def configure(self, values: Mapping[str, Any]) -> None:
        self.averager.seconds = values["imu.average"]
        self._max_force_error = values["imu.max_force_error"]
        self._floor = 0.0 if math.isnan(values["noise_stddev"]) else math.radians(values["noise_stddev"])
        self._latency_ns = 0 if math.isnan(values["latency"]) else round(values["latency"] * 1e9)

    def add(self, felt: Felt, temperature_c: float = math.nan, step_rad: float = 0.0) -> Reading | None:
        """Take a reading of the accelerometer; return the tilt of the average that it ends, if there is one.

        step_rad: the step of a reading, as a share of g; where it exceeds the noise no average takes the rounding away.
        """
        breaks = self.averager.breaks
        average = self.averager.add(felt)
        reading = None
        if average is not None:
            self.unrest = average.unrest(self._max_force_error, self.max_rotation)
            if self.unrest:
                self._gap = True
            else:
                reading = self._reading(average, temperature_c, step_rad)
            self._sequence += 1
        self._gap |= self.averager.breaks != breaks
        return reading

    def _reading(self, average: MeanForce, temperature_c: float, step_rad: float) -> Reading:
        x, y, z = average.tilt()
        flags = self._flags(average)
        if flags & GAP:
            self.noise.interrupt()
        if not flags & STUCK:
            self.noise.add(average.mid_ns * 1e-9, x, y, z)
        covariance = self._covariance(average) + step_rad**2 / 12 * np.eye(3)
        xx, xy, yx, yy = covariance[:2, :2].ravel().tolist()
        return Reading(
            stamp_ns=max(average.mid_ns - self._latency_ns, 0),
            x=x,
            y=y,
            covariance=(xx, xy, yx, yy),
            z=z,
            z_variance=float(covariance[2, 2]),
            temperature_c=temperature_c,
            sequence=self._sequence & 0xFFFFFFFF,
            flags=flags,
        )

    def _flags(self, average: MeanForce) -> int:
        flags = GAP if self._gap else 0
        self._gap = False
        still = not np.ptp(average.forces, axis=0).any()
        if still and (self._has_noise or average.variance.any()):
            flags |= STUCK
        self._has_noise |= not still
        return flags

    def _covariance(self, average: MeanForce) -> np.ndarray:
        """Covariance from the readings, or from the scatter of the averages if that is more (IMU noise is not white)."""
        covariance = average.covariance()
        found = np.sqrt(np.diag(covariance))
        least = np.maximum(self.noise.sigma or (0.0,) * 3, self._floor)
        grown = np.maximum(least / found, 1.0)
        return covariance * np.outer(grown, grown)

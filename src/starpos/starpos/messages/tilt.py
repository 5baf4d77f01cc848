# SPDX-License-Identifier: Apache-2.0
"""Tilts: from a Tilt, to a Tilt from an inclinometer's reading, and from the accelerations of an IMU at rest.  An
accelerometer at rest measures g upward (REP 145).
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from starpos.errors import TiltError
from starpos.frozen import at_once
from starpos.instrument.inclinometer import MAX_CELSIUS, SCA100T_NOISE_RAD, SQUARE, Tilt
from starpos.instrument.tilt_log import NoiseTracker, copies
from starpos.messages.stamp import PlainHeader, PlainStamp, stamp_to_ns, stamp_to_unix
from starpos.units import STANDARD_GRAVITY

# bits of Tilt.flags, as starpos_interfaces defines them
OUT_OF_RANGE, STUCK, SATURATED, GAP, TIME_UNKNOWN = 1, 2, 4, 8, 16
UNUSABLE = OUT_OF_RANGE | STUCK | SATURATED | TIME_UNKNOWN
# rad2; a larger variance is meaningless, and might overflow
MAX_TILT_VARIANCE = 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Reading:
    """A tilt as it is published: `message_to_tilt` takes it as it takes starpos_interfaces/Tilt.

    stamp_ns: the host's time.  x, y: rad, always finite.  covariance: rad2 (xx, xy, yx, yy).
    temperature_c: deg C, or NaN if it is not known.
    z, z_variance: rad, rad2; NaN for a two-axis sensor.  frame_id: the inclinometer's frame.
    """

    stamp_ns: int
    x: float
    y: float
    covariance: tuple[float, ...]
    temperature_c: float
    sequence: int
    flags: int
    z: float = math.nan
    z_variance: float = math.nan
    frame_id: str = ""

    @property
    def header(self) -> PlainHeader:
        """Stamp and frame."""
        return PlainHeader(PlainStamp.of_ns(self.stamp_ns), self.frame_id)

    @property
    def temperature(self) -> float:
        """The temperature, as the message names it."""
        return self.temperature_c


def message_to_tilt(message: Any, unknown_stddev_rad: float = SCA100T_NOISE_RAD) -> Tilt:
    """Tilt from a message; an unknown covariance (all zeros) becomes unknown_stddev_rad on both axes.

    A tilt has two axes if the third is NaN, not filled in, or absent, as in the first release's messages.
    An impossible temperature becomes NaN, unknown.  The flags are left to the caller.  Raises TiltError for NaN, no
    stamp, angles that cannot hold together, or an impossible covariance.
    """
    covariance: np.ndarray = np.array(message.covariance, float).reshape(2, 2)
    unix_s = stamp_to_unix(message.header.stamp)
    if unix_s is None:
        raise TiltError("a tilt message has no time stamp: set header.stamp to the time of the sample.")
    if not covariance.any():
        covariance = np.eye(2) * unknown_stddev_rad**2
    elif np.isfinite(covariance).all():
        (xx, xy), (yx, yy) = covariance
        if not (xx > 0 and yy > 0 and math.isclose(xy, yx, abs_tol=1e-9 * xx) and xx * yy > xy * yx):
            raise TiltError(
                "a tilt message's covariance is not symmetric and positive: send zeros where it is unknown."
            )
        if max(xx, yy) > MAX_TILT_VARIANCE:
            raise TiltError("a tilt message's covariance is beyond 1 rad2: send zeros where it is unknown.")
    celsius = message.temperature if abs(message.temperature) <= MAX_CELSIUS else math.nan
    z, z_variance = _third_axis(message)
    return Tilt(
        message.x,
        message.y,
        covariance,
        utc_unix_s=unix_s,
        temperature_c=celsius,
        theta_z=z,
        variance_z=z_variance,
    )


def _third_axis(message: Any) -> tuple[float, float]:
    """Elevation in rad and variance in rad2 of the third axis, NaN if unknown; TiltError if impossible.

    A publisher that knows only two axes may leave both at 0. If x and y allow only a level third axis, 0 may also be a
    real reading; such a tilt is refused, because the two differ by degrees.
    """
    z, variance = getattr(message, "z", math.nan), getattr(message, "z_variance", math.nan)
    # infinite angles have no sine: a `Tilt` refuses them
    if math.isnan(z) or not (math.isfinite(message.x) and math.isfinite(message.y)):
        return math.nan, math.nan
    if z == variance == 0:
        if math.sin(message.x) ** 2 + math.sin(message.y) ** 2 > 1 - SQUARE:
            raise TiltError(
                "a tilt message leaves z and z_variance at 0, and its x and y alone fit a sensor on its side: send z and "
                "its variance, or NaN for a sensor of two axes."
            )
        return math.nan, math.nan
    if not math.isfinite(z):
        raise TiltError("a tilt message's z is not a finite number: send NaN for a sensor of two axes.")
    if variance < 0 or variance > MAX_TILT_VARIANCE:
        raise TiltError(
            "a tilt message's z_variance is not from 0 to 1 rad2: send NaN or 0 where it is unknown."
        )
    return z, variance or math.nan


# Minimum number of messages in an average: fewer show no scatter.
MIN_MESSAGES = 3
# Share of the time of an average that its messages must cover.
MIN_COVERED = 0.5
# A stamp further ahead is wrong: the clocks of two hosts differ by less.
FUTURE_S = 0.1
# If stamps go back further than this, the clock was set.
NEW_TIME_S = 1.0
# A lower bound, because a simulated accelerometer may have no noise.
MIN_STDDEV_RAD = 1e-6
# Number of averages with noise after which one without noise means a stuck sensor.
MIN_NOISY = 20
# Most messages in an average.
MAX_MESSAGES = 10_000


@dataclass(frozen=True, slots=True)
class Acceleration:
    """Content of one message, at rest or not."""

    stamp_ns: int
    # Specific force, m/s2.
    force: tuple[float, float, float]
    # rad/s; 0 if it is not measured.
    rotation: float
    # In m2/s4, of each axis; 0 where it is not stated.
    variance: tuple[float, float, float]


def acceleration_of(message: Any) -> Acceleration:
    """Read a message; TiltError if it has no stamp or holds NaN, infinity or a negative variance."""
    stamp_ns = stamp_to_ns(message.header.stamp)
    if stamp_ns <= 0:
        raise TiltError("has no stamp")
    a, w = message.linear_acceleration, message.angular_velocity
    force = (a.x, a.y, a.z)
    # A covariance that begins with -1 says that the quantity is not measured. The force is checked against g anyway.
    rotation: tuple[float, ...] = (0.0,) if message.angular_velocity_covariance[0] == -1 else (w.x, w.y, w.z)
    stated = message.linear_acceleration_covariance
    variance = (float(stated[0]), float(stated[4]), float(stated[8]))
    if stated[0] == -1:
        variance = (0.0, 0.0, 0.0)
    if not all(map(math.isfinite, (*force, *rotation, *variance))) or min(variance) < 0:
        raise TiltError("holds NaN, infinity or a negative variance")
    return Acceleration(stamp_ns, force, math.hypot(*rotation), variance)


@at_once
@dataclass(frozen=True)
class MeanForce:
    """The messages of one span of time; forces is (N, 3), see `Acceleration`, of what is published twice once."""

    forces: np.ndarray
    mid_ns: int
    # Root mean square, rad/s.
    rotation: float
    # (3,) m2/s4, as stated for one message.
    variance: np.ndarray

    @classmethod
    def of(cls, messages: list[Acceleration]) -> "MeanForce":
        forces = np.array([m.force for m in messages])
        moves = np.diff(forces, axis=0)
        new = np.append(True, moves.any(1)) if copies(moves) > 1 else slice(None)
        return cls(
            forces[new],
            (messages[0].stamp_ns + messages[-1].stamp_ns) // 2,
            math.sqrt(sum(m.rotation**2 for m in messages) / len(messages)),
            np.mean([m.variance for m in messages], axis=0),
        )

    @property
    def force(self) -> np.ndarray:
        return self.forces.mean(0)

    @property
    def excess(self) -> float:
        """Ratio of the stated standard deviation to the scatter, for the axis where it is smallest."""
        scatter = self.forces.var(0, ddof=1)
        return float(np.sqrt(np.min(self.variance / scatter))) if scatter.all() else 0.0

    def unrest(self, max_force_error: float, max_rotation: float) -> str:
        """Say why it gives no tilt (limits: a share of g, rad/s); '' if it gives one."""
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
        # d asin(u) = du / cos, du = (1 - u u^T) df / |f|: cos is the length of the row, which a vertical axis has not
        across = np.eye(3) - np.outer(up, up)
        slope = across / np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-9) / strength
        return slope @ forces @ slope.T / len(self.forces) + MIN_STDDEV_RAD**2 * np.eye(3)


class ForceAverager:
    """Averages messages over a given time, in the order of their stamps; counts the messages it drops."""

    def __init__(self, seconds: float) -> None:
        self.seconds = seconds
        self.duplicates = self.disordered = 0
        # How often the sequence of averages was interrupted.
        self.breaks = 0
        self._messages: list[Acceleration] = []
        self._last_ns = 0

    def restart(self) -> None:
        """Forget the messages of an average that is not complete; the next one begins a new sequence."""
        self.breaks += bool(self._messages)
        self._messages = []

    def include(self, message: Acceleration) -> MeanForce | None:
        """Include a message; return the average that it completes, if that has enough messages."""
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
        if (
            len(messages) < MIN_MESSAGES
            or messages[-1].stamp_ns - messages[0].stamp_ns < MIN_COVERED * length_ns
        ):
            self.breaks += bool(messages)
            return None
        return MeanForce.of(messages)


class ImuTilts:
    """Averages the messages of an IMU, or the readings of any accelerometer, to tilts; counts rejected messages.

    values: the parameters noise_stddev, latency and imu.* of the inclinometer.
    unrest: why the last average gave no tilt; '' where it gave one.  frame: of the last message.
    age_s: of the last message's stamp.  excess: ratio of the last average's stated noise to its scatter.
    """

    def __init__(self, values: Mapping[str, Any]) -> None:
        self.good = self.malformed = self.future = 0
        self.unrest = self.frame = ""
        self.averager = ForceAverager(values["imu.average"])
        self._noise = NoiseTracker()
        self._sequence = 0
        # of the last message (s), and of the last average
        self.age_s = self.excess = 0.0
        self._gap = False
        # averages with noise since the last one without
        self._noisy = 0
        self.configure(values)

    def configure(self, values: Mapping[str, Any]) -> None:
        """Apply the parameters."""
        self.averager.seconds = values["imu.average"]
        self._max_force_error = values["imu.max_force_error"]
        self._max_rotation = math.radians(values["imu.max_rotation"])
        self._scatter_alone = values["imu.variance"] == "scatter"
        self._floor = 0.0 if math.isnan(values["noise_stddev"]) else math.radians(values["noise_stddev"])
        self._latency_ns = 0 if math.isnan(values["latency"]) else round(values["latency"] * 1e9)

    def restart(self) -> None:
        """Forget the sensor: another one takes its place."""
        self._noise.restart()
        self._noisy = 0
        self._gap = True
        self.averager.restart()

    @property
    def noise(self) -> tuple[float, ...] | None:
        """White noise of a tilt by axis, rad, measured from the tilts; None: too few yet."""
        return self._noise.sigma

    def receive(self, message: Any, now_ns: int) -> Reading | None:
        """Average a message; return the tilt that it completes.  now_ns: a stamp that is ahead of it is wrong."""
        self.frame = message.header.frame_id
        try:
            said = acceleration_of(message)
        except TiltError:
            self.malformed += 1
            return None
        if said.stamp_ns > now_ns + FUTURE_S * 1e9:
            self.future += 1
            return None
        self.good += 1
        self.age_s = (now_ns - said.stamp_ns) * 1e-9
        if self._scatter_alone:
            said = replace(said, variance=(0.0, 0.0, 0.0))
        return self.include(said)

    def include(
        self, said: Acceleration, temperature_c: float = math.nan, step_rad: float = 0.0
    ) -> Reading | None:
        """Average a reading of an accelerometer; return the tilt that it completes.

        step_rad: the step of a reading, as a share of g; if it exceeds the noise, averaging does not remove the rounding.
        """
        breaks = self.averager.breaks
        average = self.averager.include(said)
        reading = None
        if average is not None:
            self._sequence += 1
            self.unrest = average.unrest(self._max_force_error, self._max_rotation)
            if self.unrest:
                self._gap = True
            else:
                reading = self._reading(average, temperature_c, step_rad)
        self._gap |= self.averager.breaks != breaks
        return reading

    def _reading(self, average: MeanForce, temperature_c: float, step_rad: float) -> Reading:
        x, y, z = average.tilt()
        self.excess = average.excess
        flags = self._flags(average)
        if flags & GAP:
            self._noise.interrupt()
        if not flags & STUCK:
            self._noise.add_sample(average.mid_ns * 1e-9, x, y, z)
        covariance = self._covariance(average) + step_rad**2 / 12 * np.eye(3)
        return Reading(
            stamp_ns=max(average.mid_ns - self._latency_ns, 0),
            x=x,
            y=y,
            covariance=tuple(covariance[:2, :2].ravel().tolist()),
            z=z,
            z_variance=float(covariance[2, 2]),
            temperature_c=temperature_c,
            sequence=(self._sequence - 1) & 0xFFFFFFFF,
            flags=flags,
        )

    def _flags(self, average: MeanForce) -> int:
        flags = GAP if self._gap else 0
        self._gap = False
        still = not np.ptp(average.forces, axis=0).any()
        # a simulated IMU may have no noise at all, except while it turns
        if still and self._noisy >= MIN_NOISY:
            flags |= STUCK
        elif still:
            self._noisy = 0
        else:
            self._noisy += 1
        return flags

    def _covariance(self, average: MeanForce) -> np.ndarray:
        """Covariance from the messages, or from the scatter of the averages if that is more (IMU noise is not white)."""
        covariance = average.covariance()
        found = np.sqrt(np.diag(covariance))
        least = np.maximum(self._noise.sigma or (0.0,) * 3, self._floor)
        grown = np.maximum(least / found, 1.0)
        return covariance * np.outer(grown, grown)

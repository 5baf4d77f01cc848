# SPDX-License-Identifier: Apache-2.0
"""The source `imu`: tilts from sensor_msgs/Imu at rest. An accelerometer at rest measures g upward (REP 145)."""

import math
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from rclpy.qos import ReliabilityPolicy
from sensor_msgs.msg import Imu

from starpos_common.parameters import Parameter
from starpos_common.topics import subscription
from starpos_inclinometer.noise import NoiseTracker, noise_text
from starpos_inclinometer.sources.reading import GAP, STUCK, Counts, Health, Phase, Reading
from starpos_inclinometer.sources.source import Surroundings, TiltSource

TOPIC = "imu/data"
# m/s2; true within 0.3 % everywhere on the ground
STANDARD_GRAVITY = 9.80665
# An average needs so many messages: fewer show no scatter.
LEAST = 3
# Share of the time of an average that its messages must cover.
COVERED = 0.5
# A stamp further ahead is wrong: the clocks of two hosts differ by less.
FUTURE_S = 0.1
# If stamps go back further than this, the clock was set.
NEW_TIME_S = 1.0
# A floor, for a simulated accelerometer may have no noise.
LEAST_STDDEV_RAD = 1e-6
# Most messages in an average.
MAX_MESSAGES = 10_000
QUEUE = 512
RATE_WINDOW_S = 5.0
# Stamps that are older when they come are of another clock.
OLD_S = 5.0
# So many averages with noise make one without it that of a stuck sensor.
NOISY = 20
# A stated standard deviation over the scatter of the messages, from which on it is named as a placeholder.
PLACEHOLDER = 5.0
STATED, SCATTER = "stated", "scatter"
# Silence is reported within 2 s, with a report every second.
PATIENCE_S = 0.8


PARAMETERS = (
    Parameter(
        "imu.average",
        0.5,
        "Time over which an IMU's accelerations are averaged to one tilt; short ones are noisy, long ones late.",
        unit="s",
        minimum=0.02,
        maximum=60.0,
    ),
    Parameter(
        "imu.variance",
        STATED,
        "What tells the noise of an IMU's accelerations: stated, the variance in its messages, or their scatter if that "
        "is more; scatter alone, where the driver states a placeholder. A placeholder that is too large widens fixes.",
        choices=(STATED, SCATTER),
    ),
    Parameter(
        "imu.max_force_error",
        0.05,
        "Share by which the IMU's acceleration may differ from 9.81 m/s2; beyond it is not at rest and tells no tilt. "
        "Too small refuses an uncalibrated accelerometer, too large takes driving for leaning.",
        unit="",
        minimum=0.0001,
        maximum=0.5,
    ),
    Parameter(
        "imu.max_rotation",
        2.0,
        "Rate of rotation beyond which the IMU is not at rest, its gyroscope's own offset included.",
        unit="deg/s",
        minimum=0.001,
        maximum=360.0,
    ),
)


@dataclass(frozen=True, slots=True)
class Felt:
    """Content of one message, at rest or not."""

    stamp_ns: int
    # Specific force, m/s2.
    force: tuple[float, float, float]
    # rad/s; 0 if it is not measured.
    rotation: float
    # In m2/s4, of each axis; 0 where it is not stated.
    variance: tuple[float, float, float]


class BadMessage(ValueError):
    """A message cannot be used; the text says what is wrong with it."""


def felt(message: Imu) -> Felt:
    """Read a message; BadMessage if it has no stamp or holds NaN, infinity or a negative variance."""
    stamp_ns = message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec
    if stamp_ns <= 0:
        raise BadMessage("has no stamp")
    a, w = message.linear_acceleration, message.angular_velocity
    force = (a.x, a.y, a.z)
    # A covariance that begins with -1 says that the quantity is not measured. The force is checked against g anyway.
    rotation: tuple[float, ...] = (0.0,) if message.angular_velocity_covariance[0] == -1 else (w.x, w.y, w.z)
    stated = message.linear_acceleration_covariance
    variance = (float(stated[0]), float(stated[4]), float(stated[8]))
    if stated[0] == -1:
        variance = (0.0, 0.0, 0.0)
    if not all(map(math.isfinite, (*force, *rotation, *variance))) or min(variance) < 0:
        raise BadMessage("holds NaN, infinity or a negative variance")
    return Felt(stamp_ns, force, math.hypot(*rotation), variance)


@dataclass(frozen=True)
class MeanForce:
    """The messages of one span of time; forces is (N, 3), see `Felt`."""

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

    @property
    def excess(self) -> float:
        """How many times larger the stated standard deviation is than the scatter, by the axis where it is least so."""
        scatter = self.forces.var(0, ddof=1)
        return float(np.sqrt(np.min(self.variance / scatter))) if scatter.all() else 0.0

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


class ImuSource(TiltSource):
    """Averages the messages on TOPIC to readings."""

    parameters, name = PARAMETERS, TOPIC

    def __init__(self, host: Surroundings, values: Mapping[str, Any]) -> None:
        node = host.node
        self._clock, self._wake = host.clock, host.wake
        self._now_ns = lambda: node.get_clock().now().nanoseconds
        self._averager = ForceAverager(values["imu.average"])
        self._noise = NoiseTracker()
        self._readings: deque[Reading] = deque(maxlen=QUEUE)
        self._recent: deque[float] = deque(maxlen=QUEUE)
        self._heard_s = self._told_s = -math.inf
        self._good = self._malformed = self._future = self._sequence = 0
        self._unrest = self._frame = ""
        self._gap = False
        # averages with noise since the last one without
        self._noisy = 0
        # of the last average
        self._age_s = self._excess = 0.0
        self.configure(values)
        self._subscription = subscription(node, Imu, TOPIC, self._hear, 1000, ReliabilityPolicy.BEST_EFFORT)
        self._topic = self._subscription.topic_name

    @staticmethod
    def refusal(values: Mapping[str, Any]) -> str | None:
        return None

    def start(self) -> None:
        pass

    def stop(self) -> None:
        pass

    def configure(self, values: Mapping[str, Any]) -> None:
        self._averager.seconds = values["imu.average"]
        self._max_force_error = values["imu.max_force_error"]
        self._max_rotation = math.radians(values["imu.max_rotation"])
        self._variance = values["imu.variance"]
        self._floor = 0.0 if math.isnan(values["noise_stddev"]) else math.radians(values["noise_stddev"])
        self._latency_ns = 0 if math.isnan(values["latency"]) else round(values["latency"] * 1e9)

    def take(self) -> list[Reading]:
        taken = list(self._readings)
        self._readings.clear()
        return taken

    def _hear(self, message: Imu) -> None:
        self._heard_s = self._clock.read().monotonic_s
        self._frame = message.header.frame_id
        try:
            said = felt(message)
        except BadMessage:
            self._malformed += 1
            return
        if said.stamp_ns > self._now_ns() + FUTURE_S * 1e9:
            self._future += 1
            return
        self._good += 1
        self._age_s = (self._now_ns() - said.stamp_ns) * 1e-9
        if self._variance == SCATTER:
            said = replace(said, variance=(0.0, 0.0, 0.0))
        breaks = self._averager.breaks
        average = self._averager.add(said)
        if average is not None:
            self._tell(average)
        self._gap |= self._averager.breaks != breaks

    def _tell(self, average: MeanForce) -> None:
        before, self._unrest = self._unrest, average.unrest(self._max_force_error, self._max_rotation)
        if self._unrest:
            self._sequence += 1
            self._gap = True
            if not before:
                self._wake()
            return
        self._readings.append(self._reading(average))
        self._told_s = self._heard_s
        self._recent.append(self._heard_s)
        self._wake()

    def _reading(self, average: MeanForce) -> Reading:
        x, y, z = average.tilt()
        self._excess = average.excess
        flags = self._flags(average)
        if flags & GAP:
            self._noise.interrupt()
        if not flags & STUCK:
            self._noise.add(average.mid_ns * 1e-9, x, y, z)
        self._sequence += 1
        covariance = self._covariance(average)
        return Reading(
            stamp_ns=max(average.mid_ns - self._latency_ns, 0),
            x=x,
            y=y,
            covariance=tuple(covariance[:2, :2].ravel().tolist()),
            z=z,
            z_variance=float(covariance[2, 2]),
            temperature_c=math.nan,
            sequence=(self._sequence - 1) & 0xFFFFFFFF,
            flags=flags,
        )

    def _flags(self, average: MeanForce) -> int:
        flags = GAP if self._gap else 0
        self._gap = False
        still = not np.ptp(average.forces, axis=0).any()
        # a simulated IMU may have no noise at all, but while it turns
        if still and self._noisy >= NOISY:
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

    def health(self) -> Health:
        now_s = self._clock.read().monotonic_s
        recent = [t for t in self._recent if now_s - t < RATE_WINDOW_S]
        rate_hz = (len(recent) - 1) / (recent[-1] - recent[0]) if len(recent) > 1 else 0.0
        averager = self._averager
        counts = Counts(good=self._good, malformed=self._malformed, duplicates=averager.duplicates)
        values = {
            "messages from the future": self._future,
            "messages out of order": averager.disordered,
            "age of the stamps (s)": self._age_s,
            "IMU's frame": self._frame or "unknown",
            "noise by axis (arcsec)": noise_text(self._noise.sigma),
        }
        phase, sentence = self._phase(now_s)
        return Health(
            phase=phase,
            sentence=sentence,
            rate_hz=rate_hz,
            counts=counts,
            complaint=self._complaint(),
            step=self._clock.step,
            values=values,
        )

    def _complaint(self) -> str:
        if self._age_s > OLD_S:
            return (
                f"stamps on {self._topic} are {self._age_s:.3g} s behind this host's clock: they belong to another "
                "clock, and frames find no tilts; stamp with the time of day, or synchronise the IMU's host."
            )
        if self._excess > PLACEHOLDER:
            return (
                f"the variance on {self._topic} is a placeholder: {self._excess:.2g} times the scatter of its messages "
                f"(1 sigma), and it widens fixes; set imu.variance to {SCATTER}."
            )
        return ""

    def _phase(self, now_s: float) -> tuple[Phase, str]:
        if now_s - self._heard_s > max(PATIENCE_S, self._averager.seconds):
            return Phase.ABSENT, f"nothing comes on {self._topic}: start the IMU's driver, or remap {TOPIC}."
        if self._unrest:
            return Phase.MOVING, f"the IMU is not at rest: {self._unrest}; tilts come when it is."
        if now_s - self._told_s > PATIENCE_S + 2 * self._averager.seconds:
            return (
                Phase.GARBLED,
                f"{self._topic} brings no usable messages: check its stamps against this host's clock, and that "
                f"at least {LEAST} come in {self._averager.seconds:g} s.",
            )
        return Phase.RECEIVING, f"receiving from {self._topic}"

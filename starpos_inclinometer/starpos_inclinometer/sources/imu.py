# SPDX-License-Identifier: Apache-2.0
"""The source `imu`: tilts from sensor_msgs/Imu at rest. An accelerometer at rest measures g upward (REP 145)."""

import math
from collections import deque
from collections.abc import Mapping
from typing import Any

from rclpy.qos import ReliabilityPolicy
from sensor_msgs.msg import Imu

from starpos_common.parameters import Parameter
from starpos_common.topics import subscription
from starpos_inclinometer.noise import noise_text
from starpos_inclinometer.sources.force import FORCE_PARAMETERS, LEAST, Felt, ForceTilts
from starpos_inclinometer.sources.reading import Counts, Health, Phase, Reading
from starpos_inclinometer.sources.source import Surroundings, TiltSource

TOPIC = "imu/data"
# A stamp further ahead is wrong: the clocks of two hosts differ by less.
FUTURE_S = 0.1
QUEUE = 512
RATE_WINDOW_S = 5.0
# Silence is reported within 2 s, with a report every second.
PATIENCE_S = 0.8

PARAMETERS = (
    *FORCE_PARAMETERS,
    Parameter(
        "imu.max_rotation",
        2.0,
        "Rate of rotation beyond which the IMU is not at rest, its gyroscope's own offset included.",
        unit="deg/s",
        minimum=0.001,
        maximum=360.0,
    ),
)


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


class ImuSource(TiltSource):
    """Averages the messages on TOPIC to readings."""

    parameters, name = PARAMETERS, TOPIC

    def __init__(self, host: Surroundings, values: Mapping[str, Any]) -> None:
        node = host.node
        self._clock, self._wake = host.clock, host.wake
        self._now_ns = lambda: node.get_clock().now().nanoseconds
        self._tilts = ForceTilts(values)
        self._readings: deque[Reading] = deque(maxlen=QUEUE)
        self._recent: deque[float] = deque(maxlen=QUEUE)
        self._heard_s = self._told_s = -math.inf
        self._good = self._malformed = self._future = 0
        self._frame = ""
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
        self._tilts.configure(values)
        self._tilts.max_rotation = math.radians(values["imu.max_rotation"])

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
        unrest = self._tilts.unrest
        reading = self._tilts.add(said)
        if reading is not None:
            self._readings.append(reading)
            self._told_s = self._heard_s
            self._recent.append(self._heard_s)
            self._wake()
        elif self._tilts.unrest and not unrest:
            self._wake()

    def health(self) -> Health:
        now_s = self._clock.read().monotonic_s
        recent = [t for t in self._recent if now_s - t < RATE_WINDOW_S]
        rate_hz = (len(recent) - 1) / (recent[-1] - recent[0]) if len(recent) > 1 else 0.0
        averager = self._tilts.averager
        counts = Counts(good=self._good, malformed=self._malformed, duplicates=averager.duplicates)
        values = {
            "messages from the future": self._future,
            "messages out of order": averager.disordered,
            "IMU's frame": self._frame or "unknown",
            "noise by axis (arcsec)": noise_text(self._tilts.noise.sigma),
        }
        phase, sentence = self._phase(now_s)
        return Health(
            phase=phase,
            sentence=sentence,
            rate_hz=rate_hz,
            counts=counts,
            complaint="",
            step=self._clock.step,
            values=values,
        )

    def _phase(self, now_s: float) -> tuple[Phase, str]:
        if now_s - self._heard_s > max(PATIENCE_S, self._tilts.averager.seconds):
            return Phase.ABSENT, f"nothing comes on {self._topic}: start the IMU's driver, or remap {TOPIC}."
        if self._tilts.unrest:
            return Phase.MOVING, f"the IMU is not at rest: {self._tilts.unrest}; tilts come when it is."
        if now_s - self._told_s > PATIENCE_S + 2 * self._tilts.averager.seconds:
            return (
                Phase.GARBLED,
                f"{self._topic} brings no usable messages: check its stamps against this host's clock, and that "
                f"at least {LEAST} come in {self._tilts.averager.seconds:g} s.",
            )
        return Phase.RECEIVING, f"receiving from {self._topic}"

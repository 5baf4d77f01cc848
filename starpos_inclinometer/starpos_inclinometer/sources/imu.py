# SPDX-License-Identifier: Apache-2.0
"""The source `imu`: tilts from sensor_msgs/Imu at rest; what they are is starpos.messages.tilt's."""

import math
from collections import deque
from collections.abc import Mapping
from typing import Any

from rclpy.qos import ReliabilityPolicy
from sensor_msgs.msg import Imu

from starpos.instrument.tilt_log import noise_text
from starpos.messages.tilt import MIN_MESSAGES, ImuTilts, Reading
from starpos_common.diagnostics import time_is_simulated
from starpos_common.topics import MatchedSubscription, subscription
from starpos_inclinometer.sources.source import Counts, Health, Phase, Surroundings, TiltSource, rate_of

TOPIC = "imu/data"
QUEUE, DEPTH = 512, 1000
# Stamps that are older when they come are of another clock.
OLD_S = 5.0
# A stated standard deviation over the scatter of the messages, from which on it is named as a placeholder.
PLACEHOLDER = 5.0
# Silence is reported within 2 s, with a report every second.
PATIENCE_S = 0.8


class ImuSource(TiltSource):
    """Averages the messages on TOPIC to readings."""

    name = TOPIC

    def __init__(self, host: Surroundings, values: Mapping[str, Any]) -> None:
        self._clock, self._wake = host.clock, host.wake
        self._values = values
        self._tilts = ImuTilts(values)
        self._readings: deque[Reading] = deque(maxlen=QUEUE)
        self._recent: deque[float] = deque(maxlen=QUEUE)
        self._heard_s = self._told_s = -math.inf
        if time_is_simulated(host.node):
            # of a replay none may be lost; a simulator may offer best effort only
            self._topic = MatchedSubscription(host.node, Imu, TOPIC, self._hear, DEPTH).topic
        else:
            best_effort = ReliabilityPolicy.BEST_EFFORT
            self._topic = subscription(host.node, Imu, TOPIC, self._hear, DEPTH, best_effort).topic_name

    def restart(self) -> None:
        self._tilts = ImuTilts(self._values)
        self._readings.clear()

    def configure(self, values: Mapping[str, Any]) -> None:
        self._tilts.configure(values)

    def fetch(self) -> list[Reading]:
        readings = list(self._readings)
        self._readings.clear()
        return readings

    def _hear(self, message: Imu) -> None:
        self._heard_s = self._clock.read().monotonic_s
        before = self._tilts.unrest
        reading = self._tilts.receive(message, self._clock.now_ns())
        if reading is not None:
            self._readings.append(reading)
            self._told_s = self._heard_s
            self._recent.append(self._heard_s)
        if reading is not None or (self._tilts.unrest and not before):
            self._wake()

    def health(self) -> Health:
        now_s, tilts = self._clock.read().monotonic_s, self._tilts
        counts = Counts(good=tilts.good, malformed=tilts.malformed, duplicates=tilts.averager.duplicates)
        values = {
            "messages from the future": tilts.future,
            "messages out of order": tilts.averager.disordered,
            "age of the stamps (s)": tilts.age_s,
            "IMU's frame": tilts.frame or "unknown",
            "noise by axis (arcsec)": noise_text(tilts.noise),
        }
        phase, sentence = self._phase(now_s)
        return Health(
            phase=phase,
            sentence=sentence,
            rate_hz=rate_of(self._recent, now_s),
            counts=counts,
            complaint=self._complaint(),
            values=values,
        )

    def _complaint(self) -> str:
        if self._tilts.age_s > OLD_S:
            return (
                f"stamps on {self._topic} are {self._tilts.age_s:.3g} s behind this host's clock: they belong to another "
                "clock, and frames find no tilts; stamp with the time of day, or synchronise the IMU's host."
            )
        if self._tilts.excess > PLACEHOLDER:
            return (
                f"the variance on {self._topic} is a placeholder: {self._tilts.excess:.2g} times the scatter of its "
                f"messages (1 sigma), and it widens fixes; set imu.variance to scatter."
            )
        return ""

    def _phase(self, now_s: float) -> tuple[Phase, str]:
        average_s = self._tilts.averager.seconds
        if now_s - self._heard_s > max(PATIENCE_S, average_s):
            return Phase.ABSENT, f"nothing comes on {self._topic}: start the IMU's driver, or remap {TOPIC}."
        if self._tilts.unrest:
            return Phase.MOVING, f"the IMU is not at rest: {self._tilts.unrest}; tilts come when it is."
        if now_s - self._told_s > PATIENCE_S + 2 * average_s:
            return (
                Phase.GARBLED,
                f"{self._topic} brings no usable messages: check its stamps against this host's clock, and that "
                f"at least {MIN_MESSAGES} come in {average_s:g} s.",
            )
        return Phase.RECEIVING, f"receiving from {self._topic}"

# SPDX-License-Identifier: Apache-2.0
"""The node `inclinometer`: publishes the readings of one source on `tilt`, and its health on /diagnostics."""

import time
from collections import Counter

from rclpy.clock import JumpThreshold
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.time import Time

from starpos.messages.tilt import OUT_OF_RANGE, SATURATED, STUCK, Reading
from starpos.parameters.table import parameters_of
from starpos.session.driver import Changes
from starpos_common.diagnostics import Diagnosis, Diagnostics, Level, time_is_simulated
from starpos_common.parameters import declare
from starpos_common.topics import publisher
from starpos_inclinometer.clock import HostClock, Step
from starpos_inclinometer.sources.registry import SOURCES
from starpos_inclinometer.sources.source import Counts, Health, Phase, Surroundings
from starpos_interfaces.msg import Pulse, Tilt

# Above this share of corrupted or lost lines since the last report the link gets a warning.
BAD_SHARE = 0.05
STEP_SHOWN_S = 30.0
# The time of a replay goes back where it begins again.
BEGUN_ANEW = JumpThreshold(min_forward=None, min_backward=Duration(seconds=-1))
FLAGS = {"stuck": STUCK, "saturated": SATURATED, "out of range": OUT_OF_RANGE}


class Reporter:
    """Makes reports; each counts the samples since the report before."""

    def __init__(self) -> None:
        self._flags: Counter[str] = Counter()
        self._samples = 0
        self._counts = Counts()

    def count(self, flags: int) -> None:
        self._samples += 1
        for name, bit in FLAGS.items():
            self._flags[name] += bool(flags & bit)

    def report(self, health: Health, step: Step | None, now_s: float) -> Diagnosis:
        """Make the report of a source; step: the last one of the host's clock; now_s is monotonic."""
        counts, before, self._counts = health.counts, self._counts, health.counts
        flags, self._flags = self._flags, Counter()
        samples, self._samples = self._samples, 0
        good = counts.good - before.good
        bad = sum(
            getattr(counts, name) - getattr(before, name)
            for name in ("crc_errors", "malformed", "lost", "implausible")
        )
        level, text = Level.OK, health.sentence
        if health.phase is not Phase.RECEIVING:
            level = Level.WARN if health.phase is Phase.MOVING else Level.ERROR
        elif flags["stuck"]:
            level = Level.ERROR
            text = (
                "the sensor is stuck: the same values again and again; check its wiring, clock and reference."
            )
        elif flags["saturated"] or flags["out of range"]:
            level, text = Level.WARN, "tilt beyond the sensor's range: set the instrument more upright."
        elif health.complaint:
            level, text = Level.WARN, health.complaint
        elif step and now_s - step.monotonic_s < STEP_SHOWN_S:
            level, text = Level.WARN, step_sentence(step.seconds)
        elif bad > BAD_SHARE * (good + bad):
            level = Level.WARN
            text = f"{bad} of {good + bad} lines were corrupted or lost: check cable and grounding."
        values = {
            "phase": health.phase.value,
            "rate (Hz)": health.rate_hz,
            "samples since the last report": samples,
            **{f"of these {name}": flags[name] for name in FLAGS},
            "good lines": counts.good,
            "checksum errors": counts.crc_errors,
            "malformed lines": counts.malformed,
            "garbage bytes": counts.garbage_bytes,
            "lost samples": counts.lost,
            "doubled samples": counts.duplicates,
            "implausible samples": counts.implausible,
            "device resets": counts.restarts,
            **health.values,
        }
        return Diagnosis(level, text, values)


def step_sentence(seconds: float) -> str:
    return f"the host's clock was stepped by {seconds:+.3f} s: stamps are of the new time from there on."


class InclinometerNode(Node):
    """Publishes starpos_interfaces/Tilt on `tilt`; see README.md."""

    def __init__(self) -> None:
        super().__init__("inclinometer")
        self._values = declare(
            self,
            parameters_of("inclinometer"),
            apply=self._apply,
            check=lambda values, _: SOURCES[values["source"]].refusal(values),
        )
        self._publisher = publisher(self, Tilt, "tilt", 100)
        self._pulses = publisher(self, Pulse, "pulses", 100)
        self._phases, self._steps = Changes(self.get_logger()), Changes(self.get_logger())
        self._reporter = Reporter()
        self._wake = self.create_guard_condition(self._on_wake)
        self.host_clock = HostClock(
            lambda: self.get_clock().now().nanoseconds, lambda: time_is_simulated(self)
        )
        host = Surroundings(self, self.host_clock, self._wake.trigger)
        self._source = SOURCES[self._values["source"]](host, self._values)
        self._begun = self.get_clock().create_jump_callback(
            BEGUN_ANEW, post_callback=lambda _: self._source.restart()
        )
        self._diagnostics = Diagnostics(self, {"Link": self._report}, self._source.name)
        self._source.start()

    def close(self) -> None:
        self._source.stop()

    def _apply(self, names: frozenset[str]) -> None:
        self._source.configure(self._values)

    def _on_wake(self) -> None:
        for reading in self._source.fetch():
            self._publisher.publish(self._message(reading))
            self._reporter.count(reading.flags)
        for pulse in self._source.fetch_pulses():
            self._pulses.publish(pulse)
        if self._log(self._source.health()):
            self._diagnostics.publish()

    def _message(self, reading: Reading) -> Tilt:
        message = Tilt(covariance=list(reading.covariance))
        message.header.stamp = Time(nanoseconds=reading.stamp_ns).to_msg()
        message.header.frame_id = self._values["frame_id"]
        # A reading has the message's names.
        for name in ("x", "y", "z", "z_variance", "temperature", "sequence", "flags"):
            setattr(message, name, getattr(reading, name))
        return message

    def _log(self, health: Health) -> bool:
        """Log a line for each change; return whether there was one."""
        good, step = health.phase is Phase.RECEIVING, self.host_clock.step
        changed = self._phases.say(health.sentence, good, (health.phase, health.sentence))
        return (step is not None and self._steps.say(step_sentence(step.seconds), False, step)) or changed

    def _report(self) -> Diagnosis:
        health = self._source.health()
        self._log(health)
        return self._reporter.report(health, self.host_clock.step, time.monotonic())

# SPDX-License-Identifier: Apache-2.0
"""What a node says of its health: /diagnostics once a second, the state of its clock, troubles that repeat.

/diagnostics follows diagnostic_updater's conventions (which PyPI's ROS does not carry).
"""

import re
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.clock import ROSClock
from rclpy.node import Node

from starpos import system_clock
from starpos.session.driver import Diagnosis, Level
from starpos_common.topics import steady_timer

__all__ = ["Diagnosis", "Diagnostics", "Level"]

PERIOD_S = 1.0


class Diagnostics:
    """Publishes one DiagnosticStatus `node: Task` for every task, at 1 Hz of real time.

    In a namespace the name is `/namespace/node: Task`, as diagnostic_updater writes it with use_fqn, because all
    nodes share the topic. The rate is in real time: a health report must not stop with a paused simulation, nor
    flood a fast replay. The stamp is the node's own time. `hardware_id` may be changed at any time.
    """

    def __init__(
        self, node: Node, tasks: Mapping[str, Callable[[], Diagnosis]], hardware_id: str = "none"
    ) -> None:
        self.hardware_id = hardware_id
        self._node = node
        self._name = node.get_name() if node.get_namespace() == "/" else node.get_fully_qualified_name()
        self._tasks = dict(tasks)
        self._publisher = node.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self._timer = steady_timer(node, PERIOD_S, self.publish)

    def publish(self) -> None:
        """Publish at once, for a change that should not wait for the timer."""
        message = DiagnosticArray()
        message.header.stamp = self._node.get_clock().now().to_msg()
        message.status = [self._status(name, task) for name, task in self._tasks.items()]
        self._publisher.publish(message)

    def _status(self, name: str, task: Callable[[], Diagnosis]) -> DiagnosticStatus:
        try:
            status = task()
        except Exception as error:
            # A health report that fails must say so instead of taking the instrument down.
            status = Diagnosis(Level.ERROR, f"this diagnostic failed: {type(error).__name__}: {error}")
        return DiagnosticStatus(
            level=bytes([status.level]),
            name=f"{self._name}: {name}",
            message=status.message,
            hardware_id=self.hardware_id,
            values=[KeyValue(key=key, value=_text(value)) for key, value in status.values.items()],
        )


def _text(value: object) -> str:
    return f"{value:.9g}" if isinstance(value, float) else str(value)


# How long a step stays in the report.
TOLD_S = 30.0
# How far longitude turns.
ARCSEC_PER_S = 15.041


def time_is_simulated(node: Node) -> bool:
    """Whether the node takes its time from /clock (use_sim_time)."""
    clock = node.get_clock()
    return isinstance(clock, ROSClock) and clock.ros_time_is_active


class ClockReport:
    """Reports whether stamps can be trusted, once a second, and logs each step of the clock once.

    matters: returns False while no stamp comes from this clock.
    watch: finds the steps of the system's clock.
    """

    def __init__(self, node: Node, matters: Callable[[], bool] = lambda: True) -> None:
        self._node = node
        self._matters = matters
        self.watch = system_clock.StepWatch()
        self._set_s = self._step_s = 0.0
        # In seconds of monotonic time.
        self._stepped_at = -TOLD_S

    def __call__(self) -> Diagnosis:
        if time_is_simulated(self._node):
            return Diagnosis(Level.OK, "time is simulated (use_sim_time).")
        now = time.monotonic()
        set_s = self.watch.set_s()
        step, self._set_s = set_s - self._set_s, set_s
        # A clock that was set and set back between two reports made no step.
        if abs(step) > system_clock.STEP_S:
            self._step_s, self._stepped_at = step, now
            self._node.get_logger().warning(f"{self._said(step)}.")
        state = system_clock.read()
        values: dict[str, object] = {"last step (s)": self._step_s}
        if state is not None:
            values |= {
                "synchronised": state.synchronised,
                "maximum error (s)": state.max_error_s,
                "estimated error (s)": state.est_error_s,
            }
        if not self._matters():
            return Diagnosis(Level.OK, "the frames carry times of their own.", values)
        if now - self._stepped_at < TOLD_S:
            return Diagnosis(Level.WARN, f"{self._said(self._step_s)}.", values)
        if state is None:
            cure = "the solver assumes the error in clock_stddev"
            return Diagnosis(
                Level.WARN, f"the system does not report the error of its clock; {cure}.", values
            )
        return Diagnosis(Level.OK if state.synchronised else Level.WARN, state.sentence, values)

    def _said(self, step_s: float) -> str:
        way = "ahead" if step_s > 0 else "back"
        return (
            f"the system's clock was set {way} by {abs(step_s):.3g} s: longitudes before and after differ by "
            f"{abs(step_s) * ARCSEC_PER_S:.3g} arcsec"
        )


# A trouble is over when something goes right after so long without a failure.
QUIET_S = 10.0
# Most sentences logged for one trouble: their words may come from outside, in any number.
MAX_KINDS = 8


@dataclass
class _Trouble:
    """The time of the last failure (s, monotonic), its sentence, and the kinds of sentences that were logged."""

    since_s: float
    sentence: str
    kinds: set[str] = field(default_factory=set)


class Troubles:
    """Keeps the troubles of a node, each by the name of what fails, such as a topic."""

    def __init__(self, node: Node) -> None:
        self._log = node.get_logger()
        self._troubles: dict[str, _Trouble] = {}

    def wrong(self, what: str, sentence: str) -> None:
        """Note a failure; log it if it is of a new kind. Sentences that differ only in numbers are of one kind."""
        trouble = self._troubles.setdefault(what, _Trouble(0.0, ""))
        trouble.since_s, trouble.sentence = time.monotonic(), sentence
        kind = re.sub(r"[\d.e+-]+", "", sentence)
        if kind not in trouble.kinds and len(trouble.kinds) < MAX_KINDS:
            trouble.kinds.add(kind)
            self._log.warning(sentence)

    def right(self, what: str) -> None:
        """Note a success; log it if it ends a trouble."""
        trouble = self._troubles.get(what)
        if trouble and time.monotonic() - trouble.since_s > QUIET_S:
            del self._troubles[what]
            self._log.info(f"{what}: in order again")

    def lately(self, within_s: float) -> list[str]:
        """The last sentences of the troubles within that time."""
        now = time.monotonic()
        return [t.sentence for t in self._troubles.values() if now - t.since_s < within_s]

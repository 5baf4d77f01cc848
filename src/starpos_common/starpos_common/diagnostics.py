# SPDX-License-Identifier: Apache-2.0
"""Publishing of /diagnostics once a second, in diagnostic_updater's conventions (which PyPI's ROS does not carry)."""

from collections.abc import Callable, Mapping

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.node import Node

from starpos.session.diagnosis import Diagnosis, Level

# for the tasks of the nodes
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
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._timer = node.create_timer(PERIOD_S, self.publish, clock=self._steady)

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

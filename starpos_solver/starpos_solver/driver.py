# SPDX-License-Identifier: Apache-2.0
"""A node as the driver of a session: its log and its account of the inputs, its parameters."""

import time
from collections.abc import Callable, Mapping, Sequence

from rclpy.node import Node

from starpos.parameters.table import parameters_of
from starpos.session.driver import Now
from starpos.session.settings import NodeSettings
from starpos_common.diagnostics import Diagnosis, Level, Troubles, time_is_simulated
from starpos_common.parameters import declare

STALE_S = 5.0
# seconds of an IMU at 400 Hz that may wait while a node does something else
IMU_QUEUE = 4000


class NodeDriver:
    """Logs what a session says, and keeps account of the messages, by the relative name of their topic.

    needed: names without which there is no output.
    """

    def __init__(self, node: Node, needed: Sequence[str]) -> None:
        self.refused = 0
        self._logger = node.get_logger()
        self._needed = needed
        self._came_s: dict[str, float] = {}
        self._troubles = Troubles(node)

    # rclpy ties a severity to the calling line, so each has its own line
    def info(self, message: str) -> None:
        self._logger.info(message)

    def warning(self, message: str) -> None:
        self._logger.warning(message)

    def error(self, message: str) -> None:
        self._logger.error(message, throttle_duration_sec=60.0)

    def came(self, name: str) -> None:
        """Note a message that is sound as far as is known."""
        self._came_s[name] = time.monotonic()
        self._troubles.right(name)

    def refuse(self, name: str, sentence: str) -> None:
        """Note a message that is refused, with the reason."""
        self._came_s[name] = time.monotonic()
        self.refused += 1
        self._troubles.wrong(name, sentence)

    def report(self, kept: Mapping[str, int], dropped: Mapping[str, int]) -> Diagnosis:
        """Make the diagnostic `Inputs`; kept: what the node has of them; dropped: what was lost on the way, by topic."""
        now = time.monotonic()
        ages_s = {name: now - came for name, came in self._came_s.items()}
        missing = [name for name in self._needed if ages_s.get(name, STALE_S) >= STALE_S]
        values: dict[str, object] = {f"{name} age (s)": age for name, age in ages_s.items()}
        values |= {**kept, "refused": self.refused}
        values |= {f"{name} dropped": count for name, count in dropped.items()}
        refusals = self._troubles.lately(STALE_S)
        said = [f"nothing on {', '.join(missing)} for {STALE_S:g} s"] if missing else []
        said += [f"refused: {'; '.join(refusals)}"] if refusals else []
        if said:
            return Diagnosis(Level.WARN, "; ".join(said), values)
        return Diagnosis(Level.OK, "all inputs arrive", values)


def now_of(node: Node) -> Now:
    """The moment by the node's clock; the time that is waited is in real time, unless the clock is simulated."""
    now_ns = node.get_clock().now().nanoseconds
    unix_s = now_ns * 1e-9 if now_ns else None
    return Now.in_data(unix_s) if time_is_simulated(node) else Now(unix_s, time.monotonic())


def declared(node: Node, name: str, settings: NodeSettings, apply: Callable[[frozenset[str]], None]) -> None:
    """Declare the parameters of the node of that name for its settings, which may be set while it runs.

    apply: called with the names that were set.
    """

    def adopted(names: frozenset[str]) -> None:
        settings.adopt()
        apply(names)

    settings.values = declare(node, parameters_of(name), apply=adopted, check=settings.check)
    settings.adopt()

# SPDX-License-Identifier: Apache-2.0
"""Messages that were published and never arrived, found by DDS's numbers of a publisher's messages."""

from collections.abc import Mapping
from typing import Any

from rclpy.node import Node
from rclpy.qos import DurabilityPolicy


class Dropped:
    """Counts them by topic, and warns at the first of each, with the cure.

    This works for a single publisher: a topic with several is not reported.
    """

    def __init__(self, node: Node, cure: str) -> None:
        self._node, self._cure = node, cure
        self.counts: dict[str, int] = {}
        self._warned: set[str] = set()
        self._last: dict[str, int] = {}
        # messages that a publisher sent before the first received one, until the graph shows the publisher
        self._before: dict[str, int] = {}

    def came(self, name: str, info: Mapping[str, Any]) -> None:
        """Note a message of a topic, by its relative name, and the middleware's information on it."""
        number = info.get("publication_sequence_number")
        if number is None:
            return
        last = self._last.get(name)
        self._last[name] = number
        # a lower number comes from another publisher
        if last is None or number < last:
            self._before[name] = number - 1
        elif number - last > 1:
            self._note_missing(name, number - last - 1)
        if name in self._before:
            self._note_before(name)

    def _note_missing(self, name: str, missing: int) -> None:
        topic = self._node.resolve_topic_name(name)
        if self._node.count_publishers(topic) > 1:
            return
        if name not in self._warned:
            self._warned.add(name)
            self._node.get_logger().warning(
                f"{topic}: {missing} messages were dropped on the way: {self._cure}"
            )
        self.counts[name] = self.counts.get(name, 0) + missing

    def _note_before(self, name: str) -> None:
        topic = self._node.resolve_topic_name(name)
        publishers = self._node.get_publishers_info_by_topic(topic)
        if not publishers:
            return
        missing = self._before.pop(name)
        # of a latched topic the newest message is all there is
        if (
            missing
            and len(publishers) == 1
            and publishers[0].qos_profile.durability == DurabilityPolicy.VOLATILE
        ):
            self.counts[name] = self.counts.get(name, 0) + missing
            self._node.get_logger().warning(
                f"{topic}: {missing} messages came before this node listened: start it first"
            )

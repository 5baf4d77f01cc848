# SPDX-License-Identifier: Apache-2.0
"""Messages that were published and never arrived, told by the numbers that DDS gives a publisher's messages."""

from collections.abc import Mapping
from typing import Any

from rclpy.node import Node


class Dropped:
    """Counts them by topic, and warns at the first of each, with the cure.

    Only one publisher's numbers can be told: where a topic has several, nothing is said of it.
    """

    def __init__(self, node: Node, cure: str) -> None:
        self._node, self._cure = node, cure
        self.counts: dict[str, int] = {}
        self._last: dict[str, int] = {}

    def came(self, name: str, info: Mapping[str, Any]) -> None:
        """Note a message of a topic, by its relative name, and what the middleware tells of it."""
        number = info.get("publication_sequence_number")
        if number is None:
            return
        last = self._last.get(name)
        self._last[name] = number
        # a lower number comes from another publisher
        missing = 0 if last is None else number - last - 1
        topic = self._node.resolve_topic_name(name)
        if missing <= 0 or self._node.count_publishers(topic) > 1:
            return
        if name not in self.counts:
            self._node.get_logger().warning(
                f"{topic}: {missing} messages were dropped on the way: {self._cure}"
            )
        self.counts[name] = self.counts.get(name, 0) + missing

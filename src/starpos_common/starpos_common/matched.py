# SPDX-License-Identifier: Apache-2.0
"""A subscription to a topic of another driver: it takes the offered reliability."""

from collections.abc import Callable, Collection, Sequence
from typing import Any

from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.topic_endpoint_info import TopicEndpointInfo

from starpos_common.topics import Take, subscription

RELIABLE, BEST_EFFORT = ReliabilityPolicy.RELIABLE, ReliabilityPolicy.BEST_EFFORT
# maximum number of publishers and topics named in a sentence
MAX_NAMED = 3


class MatchedSubscription:
    """A subscription that is reliable unless all publishers of its topic offer best effort only.

    Reliable ones do not hear best effort at all, and best effort loses most large images of a reliable publisher.
    Where the user's qos_overrides say best effort, it stays so.
    """

    def __init__(self, node: Node, kind: type, topic: str, callback: Take, depth: int) -> None:
        self._node, self._kind = node, kind
        # rclpy's types know callbacks of one argument only
        self._callback: Callable[..., Any] = callback
        self._subscription = subscription(
            node, kind, topic, callback, depth, events=SubscriptionEventCallbacks(use_default_callbacks=False)
        )
        self.topic = self._subscription.topic_name
        self._qos: QoSProfile = self._subscription.qos_profile
        self._fixed = self._qos.reliability != RELIABLE
        package = kind.__module__.partition(".")[0]
        self._type = f"{package}/msg/{kind.__name__}"

    @property
    def publishers(self) -> list[TopicEndpointInfo]:
        """The publishers of this topic and type that the graph shows."""
        return [p for p in self._offered() if p.topic_type == self._type]

    def look(self) -> None:
        """Take the reliability that is offered now."""
        offered = {p.qos_profile.reliability for p in self.publishers}
        wanted = BEST_EFFORT if offered == {BEST_EFFORT} else RELIABLE
        if self._fixed or wanted == self._qos.reliability:
            return
        self._qos = QoSProfile(history=self._qos.history, depth=self._qos.depth, reliability=wanted)
        self.destroy()
        self._subscription = self._node.create_subscription(
            self._kind,
            self.topic,
            self._callback,
            self._qos,
            event_callbacks=SubscriptionEventCallbacks(use_default_callbacks=False),
        )
        how = "best effort, as its publisher" if wanted == BEST_EFFORT else "reliably"
        self._node.get_logger().info(f"{self.topic} is heard {how}.")

    def destroy(self) -> None:
        self._node.destroy_subscription(self._subscription)

    def unheard(self) -> str:
        """Sentence on the publishers that cannot be heard and why; '' without any."""
        others = [p for p in self._offered() if p.topic_type != self._type]
        if others:
            kinds = _named({p.topic_type for p in others})
            return (
                f"{_nodes(others)} sends {kinds} on {self.topic}, which takes {self._type}: remap it to the topic "
                "that carries this type."
            )
        silent = [p for p in self.publishers if self._qos.reliability == RELIABLE]
        silent = [p for p in silent if p.qos_profile.reliability == BEST_EFFORT]
        if not silent:
            return ""
        return (
            f"{_nodes(silent)} cannot be heard on {self.topic}: it offers best effort, and another publisher of the "
            "same topic reliable delivery. Give one of them another topic."
        )

    def elsewhere(self) -> str:
        """The other topics that carry this type, as the rest of a sentence; '' without any."""
        topics = [
            name
            for name, types in self._node.get_topic_names_and_types()
            if self._type in types and name != self.topic and self._node.count_publishers(name)
        ]
        return _named(topics)

    def _offered(self) -> list[TopicEndpointInfo]:
        return self._node.get_publishers_info_by_topic(self.topic)


def _nodes(publishers: Sequence[TopicEndpointInfo]) -> str:
    return _named({f"{p.node_namespace.rstrip('/')}/{p.node_name}" for p in publishers})


def _named(names: Collection[str]) -> str:
    shown = sorted(names)
    more = f" and {len(shown) - MAX_NAMED} more" if len(shown) > MAX_NAMED else ""
    return ", ".join(shown[:MAX_NAMED]) + more

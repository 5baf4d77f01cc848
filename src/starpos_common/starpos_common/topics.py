# SPDX-License-Identifier: Apache-2.0
"""Topics and timers: QoS that the user may override, a driver's reliability, lost messages, other publishers.

The QoS of each topic is in the parameters `qos_overrides.TOPIC...`.
"""

from collections import deque
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

from rclpy._rclpy_pybind11 import RCLError
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import InvalidQosOverridesError, QosCallbackResult, QoSOverridingOptions
from rclpy.subscription import Subscription
from rclpy.timer import Timer
from rclpy.topic_endpoint_info import TopicEndpointInfo

from starpos.parameters.table import ParameterError

MAX_DEPTH = 100_000
# no warning of rclpy's where a publisher does not match
SILENT = SubscriptionEventCallbacks(use_default_callbacks=False)
# A message, and the middleware's information on it.
Receiver = Callable[[Any, Mapping[str, Any]], object]


def publisher(node: Node, kind: type, topic: str, depth: int, latched: bool = False) -> Publisher:
    """Make a RELIABLE publisher that keeps the newest `depth` messages; ParameterError if an override is not allowed.

    latched: transient_local, so that late subscribers get the newest messages too.
    """
    durability = DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE
    qos = QoSProfile(depth=depth, durability=durability)
    with _overridden(node, topic):
        return node.create_publisher(kind, topic, qos, qos_overriding_options=_options())


def subscription(
    node: Node,
    kind: type,
    topic: str,
    callback: Callable,
    depth: int,
    reliability: ReliabilityPolicy = ReliabilityPolicy.RELIABLE,
    raw: bool = False,
    events: SubscriptionEventCallbacks | None = None,
) -> Subscription:
    """Make a volatile subscription that keeps the newest `depth` messages; ParameterError if an override is not allowed.

    raw: the callback takes bytes.  events: in place of rclpy's, which log publishers that do not match.
    """
    # rclpy writes the overrides into the profile: a shared profile would carry them to the next topic.
    qos = QoSProfile(depth=depth, reliability=reliability)
    with _overridden(node, topic):
        return node.create_subscription(
            kind, topic, callback, qos, raw=raw, event_callbacks=events, qos_overriding_options=_options()
        )


def subscription_from_any(node: Node, kind: type, topic: str, callback: Receiver, depth: int) -> None:
    """Subscribe to a topic of small messages however it is published; each message is taken once.

    DDS has no subscription for all: one that wants what was sent before it came hears no volatile publisher, and one
    that wants each message hears none of best effort.
    """
    taken: deque[tuple[object, object]] = deque(maxlen=3 * depth)

    def once(message: Any, info: Mapping[str, Any]) -> None:
        # the middleware's own, and so the same in all
        which = info.get("source_timestamp"), info.get("publication_sequence_number")
        if any(which) and which in taken:
            return
        taken.append(which)
        callback(message, info)

    # rclpy's types know callbacks of one argument only
    heard: Callable[..., None] = once
    subscription(node, kind, topic, heard, depth, events=SILENT)
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    best_effort = QoSProfile(depth=depth, reliability=ReliabilityPolicy.BEST_EFFORT)
    for qos in (latched, best_effort):
        node.create_subscription(kind, topic, heard, qos, event_callbacks=SILENT)


def _options() -> QoSOverridingOptions:
    return QoSOverridingOptions.with_default_policies(callback=_checked)


def _checked(qos: QoSProfile) -> QosCallbackResult:
    result = QosCallbackResult()
    result.successful = 1 <= qos.depth <= MAX_DEPTH
    result.reason = f"depth must be from 1 to {MAX_DEPTH}; {qos.depth} was given"
    return result


@contextmanager
def _overridden(node: Node, topic: str) -> Iterator[None]:
    try:
        yield
    except RCLError:
        raise
    except (RuntimeError, InvalidQosOverridesError) as error:
        # The policy has no such value, or the depth is not allowed.
        name = f"qos_overrides.{node.resolve_topic_name(topic)}"
        raise ParameterError(f"{name}: {error}.") from None


def steady_timer(node: Node, period_s: float, call: Callable[[], object], autostart: bool = True) -> Timer:
    """Make a timer of real time, which goes on while simulated time stands still or the system's clock is set back."""
    steady = Clock(clock_type=ClockType.STEADY_TIME)
    return node.create_timer(period_s, call, clock=steady, autostart=autostart)


RELIABLE, BEST_EFFORT = ReliabilityPolicy.RELIABLE, ReliabilityPolicy.BEST_EFFORT
# how often publishers are compared with a subscription
LOOK_S = 0.5
# maximum number of publishers and topics named in a sentence
MAX_NAMED = 3


class MatchedSubscription:
    """A subscription that is reliable unless all publishers of its topic offer best effort only.

    Reliable ones do not hear best effort at all, and best effort loses most large images of a reliable publisher.
    Where the user's qos_overrides say best effort, it stays so.
    """

    def __init__(
        self, node: Node, kind: type, topic: str, callback: Callable[..., object], depth: int
    ) -> None:
        self._node, self._kind = node, kind
        # rclpy's types know callbacks of one argument only
        self._callback: Callable[..., Any] = callback
        self._subscription = subscription(node, kind, topic, callback, depth, events=SILENT)
        self.topic = self._subscription.topic_name
        self._qos: QoSProfile = self._subscription.qos_profile
        self._fixed = self._qos.reliability != RELIABLE
        package = kind.__module__.partition(".")[0]
        self._type = f"{package}/msg/{kind.__name__}"
        self._look()
        self._timer = steady_timer(node, LOOK_S, self._look)

    @property
    def publishers(self) -> list[TopicEndpointInfo]:
        """The publishers of this topic and type that the graph shows."""
        return [p for p in self._offered() if p.topic_type == self._type]

    def _look(self) -> None:
        """Take the reliability that is offered now."""
        offered = {p.qos_profile.reliability for p in self.publishers}
        wanted = BEST_EFFORT if offered == {BEST_EFFORT} else RELIABLE
        if self._fixed or wanted == self._qos.reliability:
            return
        self._qos = QoSProfile(history=self._qos.history, depth=self._qos.depth, reliability=wanted)
        self._node.destroy_subscription(self._subscription)
        self._subscription = self._node.create_subscription(
            self._kind, self.topic, self._callback, self._qos, event_callbacks=SILENT
        )
        how = "best effort, as its publisher" if wanted == BEST_EFFORT else "reliably"
        self._node.get_logger().info(f"{self.topic} is heard {how}.")

    def destroy(self) -> None:
        self._node.destroy_timer(self._timer)
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
        silent = [p for p in self.publishers if p.qos_profile.reliability == BEST_EFFORT]
        if not silent or self._qos.reliability != RELIABLE:
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


class Dropped:
    """Counts them by topic, and warns at the first of each, with the cure.

    This works for a single publisher: a topic with several is not reported.
    """

    def __init__(self, node: Node, cure: str) -> None:
        self._node, self._cure = node, cure
        self.counts: dict[str, int] = {}
        self._last: dict[str, int] = {}

    def came(self, name: str, info: Mapping[str, Any]) -> None:
        """Note a message of a topic, by its relative name, and the middleware's information on it."""
        number = info.get("publication_sequence_number")
        if number is None:
            return
        last = self._last.get(name)
        self._last[name] = number
        # a lower number comes from another publisher
        missing = 0 if last is None else number - last - 1
        if missing <= 0 or self._node.count_publishers(topic := self._node.resolve_topic_name(name)) > 1:
            return
        if name not in self.counts:
            self._node.get_logger().warning(
                f"{topic}: {missing} messages were dropped on the way: {self._cure}"
            )
        self.counts[name] = self.counts.get(name, 0) + missing


def other_publishers(node: Node, publishers: Iterable[Publisher]) -> str:
    """Sentence that names them and the remap that ends it; '' without any."""
    own = node.get_fully_qualified_name()
    said = []
    for publisher in publishers:
        offered = node.get_publishers_info_by_topic(publisher.topic_name)
        names = {f"{p.node_namespace.rstrip('/')}/{p.node_name}" for p in offered} - {own}
        if names:
            name = publisher.topic_name.removeprefix(node.get_namespace().rstrip("/") + "/")
            said.append(
                f"{', '.join(sorted(names))} publishes on {publisher.topic_name}, too: put this node's elsewhere "
                f"(-r {name}:=stars/{name}, or outputs:=stars of the launch files)"
            )
    return "; ".join(said)

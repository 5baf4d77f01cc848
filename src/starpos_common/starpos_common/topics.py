# SPDX-License-Identifier: Apache-2.0
"""Publishers and subscriptions whose QoS the user may override for each topic (parameters `qos_overrides.TOPIC...`)."""

from collections import deque
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

from rclpy._rclpy_pybind11 import RCLError
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import InvalidQosOverridesError, QosCallbackResult, QoSOverridingOptions
from rclpy.subscription import Subscription

from starpos_common.parameters import ParameterError

MAX_DEPTH = 100_000
T = TypeVar("T")
# A message, and the middleware's information on it.
Take = Callable[[Any, Mapping[str, Any]], object]


def publisher(node: Node, kind: type, topic: str, depth: int, latched: bool = False) -> Publisher:
    """Make a RELIABLE publisher that keeps the newest `depth` messages; ParameterError if an override is not allowed.

    latched: transient_local, so that late subscribers get the newest messages too.
    """
    durability = DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE
    qos = QoSProfile(depth=depth, durability=durability)

    def make() -> Publisher:
        return node.create_publisher(kind, topic, qos, qos_overriding_options=_options())

    return _made(node, topic, make)


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

    def make() -> Subscription:
        return node.create_subscription(
            kind, topic, callback, qos, raw=raw, event_callbacks=events, qos_overriding_options=_options()
        )

    return _made(node, topic, make)


def subscription_from_any(node: Node, kind: type, topic: str, callback: Take, depth: int) -> None:
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
    # a publisher that one of them does not match is no reason for its warning
    silent = SubscriptionEventCallbacks(use_default_callbacks=False)
    subscription(node, kind, topic, heard, depth, events=silent)
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    best_effort = QoSProfile(depth=depth, reliability=ReliabilityPolicy.BEST_EFFORT)
    for qos in (latched, best_effort):
        node.create_subscription(kind, topic, heard, qos, event_callbacks=silent)


def _options() -> QoSOverridingOptions:
    return QoSOverridingOptions.with_default_policies(callback=_checked)


def _checked(qos: QoSProfile) -> QosCallbackResult:
    result = QosCallbackResult()
    result.successful = 1 <= qos.depth <= MAX_DEPTH
    result.reason = f"depth must be from 1 to {MAX_DEPTH}; {qos.depth} was given"
    return result


def _made(node: Node, topic: str, make: Callable[[], T]) -> T:
    try:
        return make()
    except RCLError:
        raise
    except (RuntimeError, InvalidQosOverridesError) as error:
        # The policy has no such value, or the depth is not allowed.
        name = f"qos_overrides.{node.resolve_topic_name(topic)}"
        raise ParameterError(f"{name}: {error}.") from None

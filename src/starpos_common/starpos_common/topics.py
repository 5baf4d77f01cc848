# SPDX-License-Identifier: Apache-2.0
"""Publishers and subscriptions whose QoS the user may override for each topic (parameters `qos_overrides.TOPIC...`)."""

from collections.abc import Callable
from typing import TypeVar

from rclpy._rclpy_pybind11 import RCLError
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import InvalidQosOverridesError, QosCallbackResult, QoSOverridingOptions
from rclpy.subscription import Subscription

from starpos_common.parameters import ParameterError

MOST_DEPTH = 100_000
T = TypeVar("T")


def publisher(node: Node, kind: type, topic: str, depth: int) -> Publisher:
    """Make a RELIABLE publisher that keeps the newest `depth` messages; ParameterError if an override is not allowed."""

    def make() -> Publisher:
        return node.create_publisher(kind, topic, QoSProfile(depth=depth), qos_overriding_options=_options())

    return _made(node, topic, make)


def subscription(
    node: Node,
    kind: type,
    topic: str,
    callback: Callable,
    depth: int,
    reliability: ReliabilityPolicy = ReliabilityPolicy.RELIABLE,
    raw: bool = False,
) -> Subscription:
    """Make a volatile subscription that keeps the newest `depth` messages; ParameterError if an override is not allowed.

    raw: the callback takes bytes.
    """
    # rclpy writes the overrides into the profile: a shared profile would carry them to the next topic.
    qos = QoSProfile(depth=depth, reliability=reliability)

    def make() -> Subscription:
        return node.create_subscription(
            kind, topic, callback, qos, raw=raw, qos_overriding_options=_options()
        )

    return _made(node, topic, make)


def _options() -> QoSOverridingOptions:
    return QoSOverridingOptions.with_default_policies(callback=_checked)


def _checked(qos: QoSProfile) -> QosCallbackResult:
    result = QosCallbackResult()
    result.successful = 1 <= qos.depth <= MOST_DEPTH
    result.reason = f"depth must be from 1 to {MOST_DEPTH}; {qos.depth} was given"
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

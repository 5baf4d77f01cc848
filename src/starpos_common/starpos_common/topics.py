# SPDX-License-Identifier: Apache-2.0
"""Publishers and subscriptions whose QoS the user may override, each by itself (parameters `qos_overrides.TOPIC...`)."""

from collections.abc import Callable

from rclpy._rclpy_pybind11 import RCLError
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import InvalidQosOverridesError, QosCallbackResult, QoSOverridingOptions
from rclpy.subscription import Subscription

from starpos_common.parameters import ParameterError

MOST_DEPTH = 100_000


def publisher(node: Node, kind: type, topic: str, depth: int) -> Publisher:
    """RELIABLE, the newest `depth` kept. ParameterError where an override is not allowed."""
    return _made(
        node, topic, lambda: node.create_publisher(kind, topic, QoSProfile(depth=depth), **_options())
    )


def subscription(
    node: Node,
    kind: type,
    topic: str,
    callback: Callable,
    depth: int,
    reliability: ReliabilityPolicy = ReliabilityPolicy.RELIABLE,
    raw: bool = False,
) -> Subscription:
    """Volatile, the newest `depth` kept. ParameterError where an override is not allowed.

    raw: the callback takes bytes.
    """
    # rclpy writes the overrides into the profile: one that were shared would carry them to the next topic
    qos = QoSProfile(depth=depth, reliability=reliability)
    return _made(
        node, topic, lambda: node.create_subscription(kind, topic, callback, qos, raw=raw, **_options())
    )


def _options() -> dict[str, QoSOverridingOptions]:
    return {"qos_overriding_options": QoSOverridingOptions.with_default_policies(callback=_checked)}


def _checked(qos: QoSProfile) -> QosCallbackResult:
    result = QosCallbackResult()
    result.successful = 1 <= qos.depth <= MOST_DEPTH
    result.reason = f"depth must be from 1 to {MOST_DEPTH}; {qos.depth} was given"
    return result


def _made(node: Node, topic: str, make: Callable):
    try:
        return make()
    except RCLError:
        raise
    except (RuntimeError, InvalidQosOverridesError) as error:  # a word that is none of the policy's; a depth
        name = f"qos_overrides.{node.resolve_topic_name(topic)}"
        raise ParameterError(f"{name}: {error}.") from None

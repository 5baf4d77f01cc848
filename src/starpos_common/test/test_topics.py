# SPDX-License-Identifier: Apache-2.0
"""QoS overrides reach the topic they name, and no other; small messages are heard however they are published."""

import time

import pytest
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from std_msgs.msg import String

from starpos.parameters.table import ParameterError
from starpos_common.topics import publisher, subscription, subscription_from_any
from starpos_testing.nodes import take_domain
from starpos_testing.patience import WAIT_S


@pytest.fixture
def make():
    take_domain()
    context, nodes = rclpy.Context(), []
    rclpy.init(context=context)

    def make(*overrides):
        arguments = [word for o in overrides for word in ("-p", f"qos_overrides.{o}")]
        nodes.append(rclpy.create_node("topics", context=context, cli_args=["--ros-args", *arguments]))
        return nodes[-1]

    yield make
    for node in nodes:
        node.destroy_node()
    rclpy.shutdown(context=context)


def test_an_override_of_one_topic_leaves_the_others_alone(make):
    node = make("/fix.publisher.reliability:=best_effort", "/stars.subscription.reliability:=best_effort")
    for topic in ("fix", "heading"):
        publisher(node, String, topic, 10)
    for topic in ("stars", "tilt"):
        subscription(node, String, topic, print, 10)
    best_effort = {
        about.topic_type and topic
        for topic in ("/fix", "/heading", "/stars", "/tilt")
        for about in (*node.get_publishers_info_by_topic(topic), *node.get_subscriptions_info_by_topic(topic))
        if about.qos_profile.reliability == ReliabilityPolicy.BEST_EFFORT
    }
    assert best_effort == {"/fix", "/stars"}


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("/fix.publisher.reliability:=perhaps", "qos_overrides./fix reliability perhaps"),
        # rclpy warns of it before it can be refused
        pytest.param(
            "/fix.publisher.depth:=0",
            "qos_overrides./fix depth 1 100000",
            marks=pytest.mark.filterwarnings("ignore:A zero depth:UserWarning:rclpy"),
        ),
        ("/fix.publisher.depth:=-3", "qos_overrides./fix depth 1 100000"),
    ],
)
def test_an_override_that_makes_no_sense_is_refused_in_a_sentence(make, override, words):
    with pytest.raises(ParameterError) as error:
        publisher(make(override), String, "fix", 10)
    assert all(word in str(error.value) for word in words.split())


@pytest.mark.parametrize(
    ("reliability", "durability"),
    [
        (ReliabilityPolicy.BEST_EFFORT, DurabilityPolicy.VOLATILE),
        (ReliabilityPolicy.RELIABLE, DurabilityPolicy.VOLATILE),
        (ReliabilityPolicy.RELIABLE, DurabilityPolicy.TRANSIENT_LOCAL),
    ],
)
def test_small_messages_are_heard_however_they_are_published_and_once(make, reliability, durability):
    node, heard = make(), []
    subscription_from_any(node, String, "info", lambda message, info: heard.append(message.data), 10)
    qos = QoSProfile(depth=10, reliability=reliability, durability=durability)
    sender = node.create_publisher(String, "info", qos)
    executor = SingleThreadedExecutor(context=node.context)
    executor.add_node(node)
    end_s = time.monotonic() + WAIT_S
    while "last" not in heard:
        assert time.monotonic() < end_s
        # best effort may lose one
        sender.publish(String(data="last" if heard else "first"))
        executor.spin_once(timeout_sec=0.1)
    first = heard.count("first")
    for number in range(20):
        sender.publish(String(data=str(number)))
        executor.spin_once(timeout_sec=0.1)
    while "19" not in heard:
        assert time.monotonic() < end_s
        sender.publish(String(data="19"))
        executor.spin_once(timeout_sec=0.1)
    executor.shutdown()
    assert first and max(heard.count(str(number)) for number in range(19)) == 1

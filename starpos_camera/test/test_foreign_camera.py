# SPDX-License-Identifier: Apache-2.0
"""The detector with other people's drivers: compressed, best effort, no Capture; one graph for all tests."""

import signal
from collections import deque

import cv2
import numpy as np
import pytest
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CompressedImage, Image

from starpos_camera.detector import STAMPS_KEPT, FrameTopics
from starpos_interfaces.msg import StarArray
from starpos_testing.nodes import Listener, Process

OK, WARN = 0, 1
TASK = "detector: Stars"
RAW, COMPRESSED = "camera/image_raw", "camera/image_raw/compressed"
EXPOSURE_S = 0.4
NANO = 10**9


def qos(reliability):
    return QoSProfile(depth=10, reliability=reliability)


class Graph:
    """A detector with default parameters, and the stars it sends."""

    def __init__(self):
        self.listener = Listener()
        self.stars = self.listener.hear(StarArray, "stars")
        self.process = Process("starpos_camera.main", "detector", ())
        self.listener.wait_for_state(
            TASK, WARN, "no frame has come yet on /camera/image_raw: no node publishes it"
        )
        self.stamp = 1793642400

    def publisher(self, kind, topic, reliability=ReliabilityPolicy.RELIABLE):
        """A driver's publisher, once the detector has subscribed."""
        made = self.listener.node.create_publisher(kind, topic, qos(reliability))
        self.listener.wait(made.get_subscription_count)
        return made

    def shown(self, publisher, make):
        """The stars of a message that make gives, sent until they come: best effort loses some."""
        first = self.stamp + 10

        def answered():
            self.stamp += 10
            message = make()
            message.header.stamp.sec, message.header.stamp.nanosec = self.stamp, 250_000_000
            publisher.publish(message)
            return [s for s in self.stars if s.header.stamp.sec >= first - 1]

        self.listener.wait(answered)
        return next(s for s in self.stars if s.header.stamp.sec >= first - 1)


@pytest.fixture(scope="module")
def graph(domain):
    graph = Graph()
    yield graph
    graph.process.kill()
    graph.listener.close()


@pytest.fixture(scope="module")
def pixels(frame):
    """A part of a frame, 8 bits: small enough to arrive by best effort."""
    return np.clip((frame.pixels[:240, :320].astype(float) - 400) / 8, 0, 255).astype(np.uint8)


def raw(pixels, encoding="mono8"):
    return lambda: Image(
        height=pixels.shape[0],
        width=pixels.shape[1],
        step=pixels.strides[0],
        encoding=encoding,
        data=np.ascontiguousarray(pixels).tobytes(),
    )


def compressed(pixels):
    data = cv2.imencode(".png", pixels)[1].tobytes()
    return lambda: CompressedImage(format="mono8; png compressed mono8", data=data)


@pytest.fixture(scope="module")
def of_compressed(graph, pixels):
    """The stars of a driver that sends pictures only, best effort."""
    publisher = graph.publisher(CompressedImage, COMPRESSED, ReliabilityPolicy.BEST_EFFORT)
    yield graph.shown(publisher, compressed(pixels))
    graph.listener.node.destroy_publisher(publisher)


def test_compressed_pictures_alone_are_enough(of_compressed):
    assert (of_compressed.width, of_compressed.height) == (320, 240) and len(of_compressed.stars) >= 3


def test_until_the_stamp_is_stated_it_is_wide_and_a_sentence_says_what_to_set(of_compressed, graph):
    assert (
        of_compressed.stamp_stddev == 0.3 and not of_compressed.exposure and not of_compressed.shutter_known
    )
    assert of_compressed.header.stamp.nanosec == 250_000_000
    graph.listener.wait_for_state(TASK, WARN, "set the parameters stamp, stamp_stddev and exposure")


@pytest.fixture(scope="module")
def best_effort(graph, of_compressed):
    publisher = graph.publisher(Image, RAW, ReliabilityPolicy.BEST_EFFORT)
    yield publisher
    graph.listener.node.destroy_publisher(publisher)


def test_best_effort_is_heard_and_the_raw_frames_are_preferred(best_effort, graph, pixels, of_compressed):
    colours = cv2.cvtColor(pixels, cv2.COLOR_GRAY2RGBA)
    got = graph.shown(best_effort, raw(colours, "rgba8"))
    assert len(got.stars) >= len(of_compressed.stars)
    # and the driver is not asked to compress any more
    node = graph.listener.node
    graph.listener.wait(lambda: not node.count_subscribers(f"/{COMPRESSED}"))


@pytest.mark.parametrize(
    ("stated", "later_s", "stddev_s"),
    [
        ({"stamp": "start", "stamp_stddev": 0.001}, EXPOSURE_S / 2, 0.001),
        ({"stamp": "end", "stamp_stddev": float("nan")}, -EXPOSURE_S / 2, 0.02),
        ({"stamp": "arrival", "stamp_stddev": 0.01, "readout": -0.03}, -EXPOSURE_S / 2 - 0.03, 0.01),
    ],
)
def test_what_is_stated_of_the_stamps_counts(best_effort, graph, pixels, stated, later_s, stddev_s):
    assert graph.listener.set("detector", exposure=EXPOSURE_S, **stated).successful
    got = graph.shown(best_effort, raw(pixels))
    at_ns = got.header.stamp.sec * NANO + got.header.stamp.nanosec
    assert (at_ns - round(later_s * NANO)) % NANO == 250_000_000
    assert (got.exposure, got.stamp_stddev) == (EXPOSURE_S, stddev_s)
    assert (got.shutter_known, got.readout) == ("readout" in stated, stated.get("readout", 0.0))
    graph.listener.wait_for_state(TASK, OK, "stars in")


def test_a_stamp_of_another_kind_is_refused(graph):
    refusal = graph.listener.set("detector", stamp="begin")
    assert not refusal.successful and "'', middle, start, end, arrival" in refusal.reason


def test_a_publisher_that_cannot_be_heard_is_named_with_the_reason(best_effort, graph):
    other = Listener()
    other.node.create_publisher(CompressedImage, RAW, 10)
    graph.listener.wait_for_state(
        TASK, WARN, "/listener sends sensor_msgs/msg/CompressedImage on /camera/image_raw"
    )
    other.close()


def test_a_reliable_publisher_is_heard_reliably_and_the_other_is_named(best_effort, graph, pixels):
    reliable = graph.publisher(Image, RAW)
    why = "/listener cannot be heard on /camera/image_raw: it offers best effort"
    graph.listener.wait_for_state(TASK, WARN, why)
    assert graph.shown(reliable, raw(pixels)).stars
    graph.listener.node.destroy_publisher(reliable)
    graph.listener.wait(best_effort.get_subscription_count)
    assert graph.shown(best_effort, raw(pixels)).stars
    status, out = graph.process.end(signal.SIGINT)
    assert status == 0 and why in out and "nothing says which moment" in out


def test_a_frame_that_both_topics_bring_some_frames_apart_is_taken_once_and_again_in_the_next_pass():
    taken = []
    topics = object.__new__(FrameTopics)
    topics._stamps = {kind: deque(maxlen=STAMPS_KEPT) for kind in (Image, CompressedImage)}
    topics._raw_sends, topics._take = False, lambda message, _: taken.append(message.header.stamp.sec)

    def message(kind, second):
        made = kind()
        made.header.stamp.sec = second
        return made

    for _ in range(2):
        topics._raw_sends = False
        for second in (1, 2, 3):
            topics._pass_compressed(message(CompressedImage, second), {})
        for second in (2, 3, 4, 5):
            topics._pass_raw(message(Image, second), {})
        topics._pass_compressed(message(CompressedImage, 5), {})
    assert taken == [1, 2, 3, 4, 5] * 2

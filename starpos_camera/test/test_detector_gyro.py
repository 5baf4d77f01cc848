# SPDX-License-Identifier: Apache-2.0
"""The node `detector` with `gyro`: a star is found by the trail from the readings, and not without."""

import threading
import time
from dataclasses import replace

import numpy as np
import pytest
import rclpy
from geometry_msgs.msg import Vector3
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile
from sensor_msgs.msg import CameraInfo, Image, Imu
from std_msgs.msg import Header
from test_detector import Feed

from starpos.detection import detect
from starpos.frames.exposure import Trail
from starpos.frames.frame import Frame
from starpos.instrument.camera import Camera
from starpos_camera import detector
from starpos_camera.detector import DetectorNode
from starpos_common.messages import camera_to_message, frame_to_message, unix_to_stamp
from starpos_interfaces.msg import StarArray
from starpos_testing.patience import WAIT_S
from starpos_testing.skies.rendered import field, noisy

FOCAL_PX, EXPOSURE_S, TRAIL = 5000.0, 0.02, (9.0, -12.0)
SIZE = (120, 140)


@pytest.fixture
def feed(listener, start):
    feed = Feed(listener, start, "gyro:=true", "qos_overrides./imu/data.subscription.reliability:=reliable")
    node = listener.node
    feed.readings = node.create_publisher(Imu, "imu/data", QoSProfile(depth=1000))
    feed.infos = node.create_publisher(CameraInfo, "camera/camera_info", 10)
    listener.wait(lambda: feed.readings.get_subscription_count() and feed.infos.get_subscription_count())
    return feed


def turn(feed, mid_s):
    """Readings around a time, of a camera whose frame's top is the IMU's x and its right y, to this trail."""
    x, y = np.array(TRAIL) / (FOCAL_PX * EXPOSURE_S)
    for t in np.arange(mid_s - 0.1, mid_s + 0.1, 0.005):
        rate = Vector3(x=float(x), y=float(y))
        feed.readings.publish(Imu(header=Header(stamp=unix_to_stamp(t)), angular_velocity=rate))


def test_a_star_is_found_by_the_trail_that_the_readings_tell(feed, listener):
    rng = np.random.default_rng(4)
    frame = Frame(noisy(field(SIZE, np.array([[70.3, 59.6, 1500.0]]), trail=TRAIL), rng))
    alone, told = (detect(replace(frame, trail=trail)).stars for trail in (None, Trail(middle_px=TRAIL)))
    assert len(alone) == 0 and len(told) == 1
    info = camera_to_message(Camera.from_focal(*SIZE[::-1], FOCAL_PX), "optical", 1793642400.0)

    # What is not read yet when a frame comes does not count: the readings are sent a frame ahead.
    # What is sent before the node knows its sender is lost.
    def as_told():
        feed.infos.publish(info)
        turn(feed, 1793642400 + feed.stamp + 2 + 0.123456789)
        stars = feed.wait_for(feed.send(frame, exposure=EXPOSURE_S)).stars
        return len(stars) == 1 and abs(stars[0].x - told.x[0]) < 1e-4

    listener.wait(as_told)


def test_a_picture_that_takes_long_to_decode_leaves_the_executor_free(monkeypatch, frame):
    """The picture of the compressed topic is decoded in the worker's thread, with a gyro as without one."""
    context = rclpy.Context()
    rclpy.init(context=context)
    node = DetectorNode(context=context, parameter_overrides=[Parameter("gyro", value=True)])
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    node.listen()
    begun, go_on, threads, stars = threading.Event(), threading.Event(), [], []

    def slow(message):
        threads.append(threading.current_thread())
        begun.set()
        assert go_on.wait(WAIT_S)
        return frame

    monkeypatch.setattr(detector, "message_to_frame", slow)
    node.create_subscription(StarArray, "stars", stars.append, 10)
    sender = node.create_publisher(Image, "camera/image_raw", 10)
    ticks = []
    node.create_timer(0.01, lambda: ticks.append(begun.is_set()))
    try:
        message = frame_to_message(frame, "optical")
        end_s = time.monotonic() + WAIT_S
        while not stars:
            assert time.monotonic() < end_s
            if not begun.is_set():
                message.header.stamp.sec += 1
                sender.publish(message)
            # the executor has gone on while the picture is being decoded
            if sum(ticks) > 5:
                go_on.set()
            executor.spin_once(timeout_sec=0.05)
    finally:
        go_on.set()
        executor.shutdown()
        node.close()
        node.destroy_node()
        rclpy.shutdown(context=context)
    assert threading.current_thread() not in threads

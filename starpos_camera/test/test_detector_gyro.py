# SPDX-License-Identifier: Apache-2.0
"""The node `detector` with `gyro`: a star is found by the trail from the readings, and not without."""

from dataclasses import replace

import numpy as np
import pytest
from geometry_msgs.msg import Vector3
from rclpy.qos import QoSProfile
from sensor_msgs.msg import CameraInfo, Imu
from std_msgs.msg import Header
from test_detector import Feed

from starpos.detection import detect
from starpos.frames.exposure import Trail
from starpos.frames.frame import Frame
from starpos.instrument.camera import Camera
from starpos_common.messages import camera_to_message, unix_to_stamp
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

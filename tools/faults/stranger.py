# SPDX-License-Identifier: Apache-2.0
"""Another inclinometer, until it is killed: `stranger.py THETA_X THETA_Y` (rad) publishes at the times of /clock."""

import sys

import numpy as np
import rclpy
from accelerated import LATENCY_S
from rclpy.qos import QoSProfile
from rosgraph_msgs.msg import Clock

from starpos_common.messages import unix_to_stamp
from starpos_interfaces.msg import Tilt
from starpos_testing.graph.shots import EXPOSURE_S, SAMPLES


def main(x: float, y: float):
    rclpy.init()
    node = rclpy.create_node("stranger")
    tilt = node.create_publisher(Tilt, "tilt", QoSProfile(depth=100))

    def on_clock(message: Clock):
        begin_s = message.clock.sec + message.clock.nanosec * 1e-9 - LATENCY_S - EXPOSURE_S
        for moment in begin_s + (np.arange(SAMPLES) + 0.5) * EXPOSURE_S / SAMPLES:
            reading = Tilt(x=x, y=y, temperature=8.0, covariance=[1e-12, 0.0, 0.0, 1e-12])
            reading.header.stamp = unix_to_stamp(float(moment))
            reading.header.frame_id = "starpos_inclinometer_frame"
            tilt.publish(reading)

    node.create_subscription(Clock, "/clock", on_clock, QoSProfile(depth=10))
    rclpy.spin(node)


if __name__ == "__main__":
    main(*map(float, sys.argv[1:]))

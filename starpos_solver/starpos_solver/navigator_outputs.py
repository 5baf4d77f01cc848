# SPDX-License-Identifier: Apache-2.0
"""The navigator's topics: `navigator/fix`, `navigator/heading`, `navigator/odometry` and `/tf` of an output."""

import numpy as np
from geometry_msgs.msg import Point, Vector3
from nav_msgs.msg import Odometry
from rclpy.node import Node
from sensor_msgs.msg import Imu, NavSatFix
from std_msgs.msg import Header

from starpos.earth.vertical import Geodetic
from starpos.navigation.voyage_fix import VoyageFix
from starpos.session.navigator import Navigated, Position
from starpos.session.navigator_parameters import NavigatorSettings
from starpos_common.messages import unix_to_stamp
from starpos_common.topics import publisher
from starpos_solver import outputs
from starpos_solver.transforms import MovingTransform


class NavigatorPublishers:
    """Publishes what the session makes, with the present parameters."""

    def __init__(self, node: Node, settings: NavigatorSettings) -> None:
        self._values = settings.values
        self._fix = publisher(node, NavSatFix, "navigator/fix", 10)
        self._heading = publisher(node, Imu, "navigator/heading", 10)
        self._odometry = publisher(node, Odometry, "navigator/odometry", 10)
        self._transform = MovingTransform(node)
        self.parameters_set()

    def parameters_set(self) -> None:
        """Create the topics that the parameters ask for."""
        self._transform.open(self._values["publish_tf"])

    def publish(self, output: Navigated) -> None:
        """Publish one output; without support it is a NO_FIX alone, and at a known place a heading."""
        frame = self._values["frame_id"]
        header = Header(stamp=unix_to_stamp(output.utc_unix_s), frame_id=frame)
        if output.at_place is not None:
            self._heading.publish(outputs.imu_at_place(header, output.at_place))
            return
        altitude = self._values["altitude"], self._values["altitude_stddev"]
        self._fix.publish(outputs.nav_sat_fix(header, output.ground, *altitude))
        if output.fix is None or output.ground is None:
            return
        self._heading.publish(outputs.imu(header, output.fix, output.ground))
        if output.position is None:
            return
        start = Header(stamp=header.stamp, frame_id=self._values["odometry_frame_id"])
        message = odometry(start, frame, output.fix, output.ground, output.position)
        self._odometry.publish(message)
        self._transform.publish(message)


def odometry(header: Header, child: str, fix: VoyageFix, ground: Geodetic, position: Position) -> Odometry:
    """Make the Odometry: pose in the frame of the header, ENU; velocity along the axes of the child's."""
    message = Odometry(header=header, child_frame_id=child)
    message.pose.pose.position = Point(**dict(zip("xyz", position.enu.tolist(), strict=True)))
    message.pose.pose.orientation, turn = outputs.attitude(fix, ground)
    pose, twist = np.zeros((2, 6, 6))
    pose[:3, :3], pose[3:, 3:] = position.covariance, turn
    message.pose.covariance = pose.ravel()
    velocity = fix.link_to_enu.T @ fix.velocity
    message.twist.twist.linear = Vector3(**dict(zip("xyz", velocity.tolist(), strict=True)))
    twist[:3, :3] = fix.link_to_enu.T @ fix.velocity_covariance @ fix.link_to_enu
    # rates are the IMU's own
    twist[3, 3] = -1.0
    message.twist.covariance = twist.ravel()
    return message

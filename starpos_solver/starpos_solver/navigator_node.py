# SPDX-License-Identifier: Apache-2.0
"""The node `navigator`: takes an IMU, attitudes and velocities, publishes place, heading and velocity under way."""

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from geometry_msgs.msg import Point, TwistWithCovarianceStamped, Vector3
from nav_msgs.msg import Odometry
from rclpy.node import Node
from rclpy.qos import ReliabilityPolicy
from sensor_msgs.msg import Imu, NavSatFix
from std_msgs.msg import Header
from std_srvs.srv import Trigger

from starpos.fix.attitude import Attitude
from starpos.session.driver import Now
from starpos.session.navigator import Navigated, NavigatorSession, NavigatorSettings
from starpos_common.diagnostics import Diagnostics
from starpos_common.messages import quaternion, unix_to_stamp
from starpos_common.topics import publisher, subscription
from starpos_common.worker import JobRunner
from starpos_interfaces import msg
from starpos_solver import outputs
from starpos_solver.driver import IMU_QUEUE, NodeDriver, declared, now_of
from starpos_solver.publishing import MOVING, MOVING_QOS, Transforms, transform_of


class NavigatorPublishers:
    """Publishes what the session makes, with the present parameters."""

    def __init__(self, node: Node, settings: NavigatorSettings) -> None:
        self._values = settings.values
        self._fix = publisher(node, NavSatFix, "navigator/fix", 10)
        self._heading = publisher(node, Imu, "navigator/heading", 10)
        self._odometry = publisher(node, Odometry, "navigator/odometry", 10)
        self._transform = Transforms(node, MOVING, MOVING_QOS)
        self.parameters_set()

    def parameters_set(self) -> None:
        """Create the topics that the parameters ask for."""
        self._transform.open(self._values["publish_tf"])

    def publish(self, output: Navigated) -> None:
        """Publish one output; without support it is a NO_FIX alone, and at a known place a heading."""
        frame = self._values["frame_id"]
        header = Header(stamp=unix_to_stamp(output.utc_unix_s), frame_id=frame)
        if output.at_place is not None:
            self._heading.publish(outputs.imu(header, output.at_place))
            return
        self._fix.publish(outputs.nav_sat_fix(header, output.ground, self._values))
        if output.fix is None or output.ground is None:
            return
        link = outputs.true_north(output.fix.link, output.ground)
        self._heading.publish(outputs.imu(header, link))
        if output.displacement is None:
            return
        start = Header(stamp=header.stamp, frame_id=self._values["odometry_frame_id"])
        message = odometry(start, frame, output, link)
        self._odometry.publish(message)
        self._transform.publish([transform_of(message)])


def odometry(header: Header, child: str, output: Navigated, link: Attitude) -> Odometry:
    """Make the Odometry: pose in the frame of the header, ENU; velocity along the axes of the child's.

    link: attitude of the base link in true-north ENU.
    """
    assert output.fix is not None and output.displacement is not None
    fix, (displacement, covariance) = output.fix, output.displacement
    message = Odometry(header=header, child_frame_id=child)
    message.pose.pose.position = Point(**dict(zip("xyz", displacement.tolist(), strict=True)))
    message.pose.pose.orientation = quaternion(link.rotation)
    pose, twist = np.zeros((2, 6, 6))
    pose[:3, :3], pose[3:, 3:] = covariance, link.covariance
    message.pose.covariance = pose.ravel()
    velocity = fix.link.rotation.T @ fix.velocity
    message.twist.twist.linear = Vector3(**dict(zip("xyz", velocity.tolist(), strict=True)))
    twist[:3, :3] = fix.link.rotation.T @ fix.velocity_covariance @ fix.link.rotation
    # rates are the IMU's own
    twist[3, 3] = -1.0
    message.twist.covariance = twist.ravel()
    return message


class NavigatorNode(Node):
    """Publishes the place of a vehicle under way; see README.md.  Decisions are in starpos.session."""

    def __init__(self) -> None:
        super().__init__("navigator")
        self._settings = NavigatorSettings({})
        declared(self, "navigator", self._settings, self._apply)
        self._driver = NodeDriver(self, ("imu/data", "attitude"))
        self._session = NavigatorSession(self._settings, JobRunner(self), self._driver)
        self._outputs = NavigatorPublishers(self, self._settings)
        session, best_effort = self._session, ReliabilityPolicy.BEST_EFFORT
        subscription(self, Imu, "imu/data", self._receiver(session.receive_imu), IMU_QUEUE, best_effort)
        subscription(self, msg.Attitude, "attitude", self._receiver(session.receive_attitude), 100)
        for kind, name in ((Odometry, "odom"), (TwistWithCovarianceStamped, "twist")):
            receive = self._receiver(partial(session.receive_velocity, name=name))
            subscription(self, kind, name, receive, 1000, best_effort)
        subscription(self, NavSatFix, "gnss/fix", self._receiver(session.receive_gnss), 10, best_effort)
        self.create_service(Trigger, "~/reset", self._on_reset)
        self._diagnostics = Diagnostics(
            self,
            {"Navigation": session.report, "Inputs": lambda: self._driver.report({}, {})},
            self._settings.values["frame_id"],
        )

    def _apply(self, names: frozenset[str]) -> None:
        self._diagnostics.hardware_id = self._settings.values["frame_id"]
        self._outputs.parameters_set()
        self._session.parameters_set()

    def _receiver(self, by_session: Callable[[Any, Now], list[Navigated]]) -> Callable[[Any], None]:
        """What takes the messages of a topic: the session receives them, and its outputs are published."""

        def receive(message: Any) -> None:
            for output in by_session(message, now_of(self)):
                self._outputs.publish(output)

        return receive

    def _on_reset(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._session.reset()
        response.success, response.message = True, "the voyage is forgotten; a new one begins"
        return response

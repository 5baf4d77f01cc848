# SPDX-License-Identifier: Apache-2.0
"""The topics that the solver publishes, and the transforms of both nodes."""

from copy import deepcopy
from functools import cached_property
from importlib.util import find_spec

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import TransformStamped, Vector3
from nav_msgs.msg import Odometry
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import Imu, NavSatFix
from std_msgs.msg import Header

from starpos.instrument.instrument import Instrument
from starpos.session.driver import Answered, Output
from starpos.session.settings import Settings
from starpos_common.messages import attitude_to_message, quaternion
from starpos_common.topics import publisher
from starpos_interfaces import msg
from starpos_solver import outputs

STATIC, MOVING = "/tf_static", "/tf"
# as tf2_ros has them
STATIC_QOS = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
MOVING_QOS = QoSProfile(depth=100)


def transforms_of(
    instrument: Instrument, link: str, camera: str, inclinometer: str
) -> list[TransformStamped]:
    """Make the transforms of an instrument whose frames have these names; a frame without a name is left out.

    So is the inclinometer without a known A3, a missing inclinometer, and a frame that is in the tree already.  They are
    without a stamp; positions are not measured.
    """
    if not camera:
        return []
    found = [_transform(link, camera, np.asarray(instrument.link_to_camera, float).T)]
    if inclinometer and instrument.vertical is None and not instrument.calibration.unknown:
        found.append(_transform(camera, inclinometer, instrument.calibration.a3.T))
    names, tree = {link}, []
    for transform in found:
        if transform.child_frame_id not in names:
            names.add(transform.child_frame_id)
            tree.append(transform)
    return tree


def _transform(parent: str, child: str, matrix: np.ndarray) -> TransformStamped:
    message = TransformStamped(header=Header(frame_id=parent), child_frame_id=child)
    message.transform.rotation = quaternion(matrix)
    return message


def transform_of(odometry: Odometry) -> TransformStamped:
    """Make the transform that puts the child frame of an Odometry into the frame of its header."""
    message, pose = TransformStamped(header=odometry.header), odometry.pose.pose
    message.child_frame_id = odometry.child_frame_id
    message.transform.translation = Vector3(x=pose.position.x, y=pose.position.y, z=pose.position.z)
    message.transform.rotation = pose.orientation
    return message


class Transforms:
    """Publishes transforms on a topic of tf while they are wanted, if tf's messages are installed."""

    def __init__(self, node: Node, topic: str, qos: QoSProfile) -> None:
        self._node, self._topic, self._qos = node, topic, qos
        self._publisher: Publisher | None = None

    def open(self, wanted: bool) -> None:
        """Have the topic if it is wanted and possible; remove it if not, and with it what is latched."""
        if not wanted and self._publisher is not None:
            self._node.destroy_publisher(self._publisher)
            self._publisher = None
        elif wanted and self._publisher is None and self._possible:
            from tf2_msgs.msg import TFMessage

            self._publisher = self._node.create_publisher(TFMessage, self._topic, self._qos)

    @cached_property
    def _possible(self) -> bool:
        """Whether there are messages of tf; said in the log if not. Looking takes longer than a fix: it is done once."""
        if find_spec("tf2_msgs") is not None:
            return True
        self._node.get_logger().info(
            f"tf2_msgs is not installed, so there is no {self._topic}: sudo apt install ros-jazzy-tf2-msgs, or set "
            "publish_tf to false"
        )
        return False

    def publish(self, transforms: list[TransformStamped]) -> None:
        """Publish them if the topic is open."""
        if self._publisher is not None:
            from tf2_msgs.msg import TFMessage

            self._publisher.publish(TFMessage(transforms=transforms))


class StaticTransforms(Transforms):
    """Publishes the transforms of an instrument as they change."""

    def __init__(self, node: Node) -> None:
        super().__init__(node, STATIC, STATIC_QOS)
        self._published: list[TransformStamped] = []

    def update(
        self, wanted: bool, link: str, camera: str, inclinometer: str, instrument: Instrument | None
    ) -> None:
        """Publish the known transforms, if they differ from before; withdraw them if they are not wanted.

        link, camera, inclinometer: names of the frames.  instrument: in use, None before there is one.
        """
        self.open(wanted)
        found: list[TransformStamped] = []
        if instrument is not None and self._publisher is not None:
            found = transforms_of(instrument, link, camera, inclinometer)
        if found != self._published:
            self._published, stamped = found, deepcopy(found)
            for message in stamped:
                message.header.stamp = self._node.get_clock().now().to_msg()
            self.publish(stamped)


class SolutionPublishers:
    """Publishes solutions with the present parameters of the node."""

    def __init__(self, node: Node, settings: Settings) -> None:
        self._settings, self._values = settings, settings.values
        self._fix = publisher(node, NavSatFix, "fix", 10)
        self._fix_averaged = publisher(node, NavSatFix, "fix_averaged", 10)
        self._imu = publisher(node, Imu, "heading/imu", 10)
        self._attitude = publisher(node, msg.Attitude, "attitude", 10)
        self._solution = publisher(node, msg.Solution, "solver/solution", 10)
        orbits = settings.orbits is not None
        self._by_satellites = publisher(node, NavSatFix, "satellites/fix", 10) if orbits else None
        self._check = publisher(node, msg.GnssCheck, "gnss/check", 10) if self._values["gnss.use"] else None

    @property
    def shared(self) -> tuple[Publisher, ...]:
        """The publishers of topics whose names other drivers have, too."""
        return self._fix, self._imu

    def publish(self, output: Output) -> None:
        header = self._header(output.stamp)
        if not isinstance(output, Answered):
            if self._by_satellites is not None:
                self._by_satellites.publish(outputs.fix_by_satellites(header, output.fix))
            return
        self._fix.publish(outputs.nav_sat_fix(header, output.ground, self._values))
        fix, at_place = output.solution.fix, output.solution.at_place
        if at_place is not None:
            self._imu.publish(outputs.imu(header, at_place.true_north))
        elif fix is not None and output.ground is not None:
            self._imu.publish(outputs.imu(header, outputs.true_north(fix.link, output.ground)))
        if self._check is not None and output.compared is not None:
            self._check.publish(outputs.gnss_check(header, output.compared))
        if output.attitude is not None:
            self._attitude.publish(attitude_to_message(output.attitude))
        self._solution.publish(self.solution(output))
        if output.average is not None:
            ground = output.average.on_ground(self._settings.vertical)
            self._fix_averaged.publish(outputs.nav_sat_fix(header, ground, self._values))

    def solution(self, answered: Answered) -> msg.Solution:
        message = outputs.solution(self._header(answered.stamp), answered.solution, answered.ground)
        if answered.no_camera:
            message.status = msg.Solution.NO_CAMERA
        return message

    def _header(self, stamp: Time) -> Header:
        return Header(stamp=stamp, frame_id=self._values["frame_id"])

# SPDX-License-Identifier: Apache-2.0
"""The instrument in the robot's tree of frames.

`/tf_static`: how camera and inclinometer are turned against the base link, latched, and again when that changes; `/tf`:
where the base link is under way.
"""

from functools import cached_property
from importlib.util import find_spec

from geometry_msgs.msg import Quaternion, TransformStamped, Vector3
from nav_msgs.msg import Odometry
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile

from starpos.instrument.instrument import Instrument
from starpos.session.transforms import FrameNames, Transform, transforms_of

STATIC, MOVING = "/tf_static", "/tf"
# as tf2_ros has them
STATIC_QOS = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
MOVING_QOS = QoSProfile(depth=100)


class StaticTransforms:
    """Publishes the transforms of an instrument."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._publisher: Publisher | None = None
        self._published: tuple[Transform, ...] = ()

    def update(self, wanted: bool, link: str, names: FrameNames, instrument: Instrument | None) -> None:
        """Publish the known transforms, if they differ from before; withdraw them if they are not wanted.

        link: name of the base link.  names: of the others.  instrument: that in use, None before there is one.
        """
        if not wanted:
            self._close()
        elif self._possible:
            self._publish(
                transforms_of(instrument, link, names.camera, names.inclinometer) if instrument else ()
            )

    @cached_property
    def _possible(self) -> bool:
        return _can_be_told(self._node, STATIC)

    def _publish(self, transforms: tuple[Transform, ...]) -> None:
        from tf2_msgs.msg import TFMessage

        if self._publisher is None:
            self._publisher = self._node.create_publisher(TFMessage, STATIC, STATIC_QOS)
        if transforms != self._published:
            self._published = transforms
            self._publisher.publish(TFMessage(transforms=[self._message(t) for t in transforms]))

    def _close(self) -> None:
        if self._publisher is not None:
            # and with it what is latched
            self._node.destroy_publisher(self._publisher)
            self._publisher, self._published = None, ()

    def _message(self, transform: Transform) -> TransformStamped:
        message = TransformStamped(child_frame_id=transform.child)
        message.header.frame_id = transform.parent
        message.header.stamp = self._node.get_clock().now().to_msg()
        x, y, z, w = transform.quaternion
        message.transform.rotation = Quaternion(x=x, y=y, z=z, w=w)
        return message


class MovingTransform:
    """Publishes where the child frame of an Odometry is in the frame of its header."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._publisher: Publisher | None = None

    def open(self, wanted: bool) -> None:
        """Have the topic if it is wanted and possible, before there is a pose; remove it if not."""
        if not wanted:
            if self._publisher is not None:
                self._node.destroy_publisher(self._publisher)
                self._publisher = None
        elif self._publisher is None and self._possible:
            from tf2_msgs.msg import TFMessage

            self._publisher = self._node.create_publisher(TFMessage, MOVING, MOVING_QOS)

    @cached_property
    def _possible(self) -> bool:
        return _can_be_told(self._node, MOVING)

    def publish(self, odometry: Odometry) -> None:
        """Publish a pose if the topic is open."""
        if self._publisher is None:
            return
        from tf2_msgs.msg import TFMessage

        pose = odometry.pose.pose
        message = TransformStamped(header=odometry.header, child_frame_id=odometry.child_frame_id)
        message.transform.translation = Vector3(x=pose.position.x, y=pose.position.y, z=pose.position.z)
        message.transform.rotation = pose.orientation
        self._publisher.publish(TFMessage(transforms=[message]))


def _can_be_told(node: Node, topic: str) -> bool:
    """Whether there are messages of tf; says in the log if not. Looking takes longer than a fix: ask once."""
    if find_spec("tf2_msgs") is not None:
        return True
    node.get_logger().info(
        f"tf2_msgs is not installed, so there is no {topic}: sudo apt install ros-jazzy-tf2-msgs, or set publish_tf to "
        "false"
    )
    return False

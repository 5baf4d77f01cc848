# SPDX-License-Identifier: Apache-2.0
"""`/tf_static`: how camera and inclinometer are turned against the base link, latched, and again when that changes."""

from importlib.util import find_spec

from geometry_msgs.msg import Quaternion, TransformStamped
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile

from starpos.instrument.instrument import Instrument
from starpos.session.transforms import Transform, transforms_of

TOPIC = "/tf_static"
# as tf2_ros has it
QOS = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
LACKING = (
    "tf2_msgs is not installed, so there is no /tf_static: sudo apt install ros-jazzy-tf2-msgs, or set publish_tf "
    "to false"
)


class StaticTransforms:
    """Publishes the transforms of an instrument; its frames have the names that messages give them.

    camera, inclinometer: these names, '' before a message has come.
    """

    def __init__(self, node: Node) -> None:
        self.camera = self.inclinometer = ""
        self._node = node
        self._publisher: Publisher | None = None
        self._published: tuple[Transform, ...] = ()

    def update(self, wanted: bool, link: str, instrument: Instrument | None) -> None:
        """Publish what is known, if it differs from before; take it back if it is not wanted.

        link: name of the base link.  instrument: that in use, None before there is one.
        """
        if not wanted:
            self._close()
        elif find_spec("tf2_msgs") is None:
            self._node.get_logger().info(LACKING, once=True)
        else:
            self._publish(
                transforms_of(instrument, link, self.camera, self.inclinometer) if instrument else ()
            )

    def _publish(self, transforms: tuple[Transform, ...]) -> None:
        from tf2_msgs.msg import TFMessage

        if self._publisher is None:
            self._publisher = self._node.create_publisher(TFMessage, TOPIC, QOS)
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

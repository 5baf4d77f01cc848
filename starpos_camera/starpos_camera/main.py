# SPDX-License-Identifier: Apache-2.0
"""The executables. Their imports are heavy, so they come after the signal handlers (see starpos_common)."""

from collections.abc import Iterator
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rclpy.node import Node


def camera() -> int:
    """Run the node `camera`."""
    from starpos_common.node_main import run

    def make_nodes() -> "Iterator[Node]":
        from starpos_camera.camera import CameraNode

        yield CameraNode()

    return run(
        make_nodes, help_text=lambda: _help("camera", "The frames of a camera, until Ctrl-C.", "camera")
    )


def detector() -> int:
    """Run the node `detector`."""
    from starpos_common.node_main import run

    def make_nodes() -> "Iterator[Node]":
        from starpos_camera.detector import DetectorNode

        node = DetectorNode()
        node.listen()
        yield node

    about = "The stars of the frames on camera/image_raw, until Ctrl-C."
    return run(make_nodes, help_text=lambda: _help("detector", about, "detector"))


def camera_detector() -> int:
    """Run both nodes in one process: frames go from one to the other directly, not through the middleware."""
    from starpos_common.node_main import run

    def make_nodes() -> "Iterator[Node]":
        from starpos_camera.camera import CameraNode
        from starpos_camera.detector import DetectorNode

        detector = DetectorNode()
        yield detector
        camera = CameraNode()
        camera.hand_to(detector)
        yield camera

    about = "The frames of a camera and their stars, two nodes in one process, until Ctrl-C."
    return run(make_nodes, help_text=lambda: _help("camera_detector", about, "camera", "detector"))


def _help(executable: str, about: str, *nodes: str) -> str:
    from starpos_common.parameters import node_help

    return node_help("starpos_camera", executable, about, *nodes)

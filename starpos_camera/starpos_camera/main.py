# SPDX-License-Identifier: Apache-2.0
"""The executables. Their imports are heavy, so they come after the signal handlers (see starpos_common)."""

from collections.abc import Iterator
from typing import TYPE_CHECKING

from starpos_common.node_main import run_executable

if TYPE_CHECKING:
    from rclpy.node import Node


def camera() -> int:
    about = "The frames of a camera, until Ctrl-C."
    return run_executable("starpos_camera", "camera", about, "camera:CameraNode")


def detector() -> int:
    about = "The stars of the frames on camera/image_raw, until Ctrl-C."
    return run_executable("starpos_camera", "detector", about, "detector:DetectorNode")


def camera_detector() -> int:
    """Run both nodes in one process: frames go from one to the other directly, not through the middleware."""

    def make_nodes() -> "Iterator[Node]":
        from starpos_camera.camera import CameraNode
        from starpos_camera.detector import DetectorNode

        detector = DetectorNode(listens=False)
        yield detector
        yield CameraNode(detector)

    about = "The frames of a camera and their stars, two nodes in one process, until Ctrl-C."
    return run_executable("starpos_camera", "camera_detector", about, make_nodes, ("camera", "detector"))

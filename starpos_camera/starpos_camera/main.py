# SPDX-License-Identifier: Apache-2.0
"""The executables. The imports inside are heavy; they come after the signal handlers (see starpos_common)."""


def camera() -> int:
    """The node `camera`."""
    from starpos_common.node_main import run

    def make_node():
        from starpos_camera.camera import CameraNode

        return CameraNode()

    return run(make_node)


def detector() -> int:
    """The node `detector`."""
    from starpos_common.node_main import run

    def make_node():
        from starpos_camera.detector import DetectorNode

        return DetectorNode()

    return run(make_node)

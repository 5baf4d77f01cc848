# SPDX-License-Identifier: Apache-2.0
"""The executables. The imports inside are heavy; they come after the signal handlers (see starpos_common)."""


def camera() -> int:
    """The node `camera`."""
    from starpos_common.node_main import run

    def make_nodes():
        from starpos_camera.camera import CameraNode

        yield CameraNode()

    return run(make_nodes)


def detector() -> int:
    """The node `detector`."""
    from starpos_common.node_main import run

    def make_nodes():
        from starpos_camera.detector import DetectorNode

        node = DetectorNode()
        node.listen()
        yield node

    return run(make_nodes)


def camera_detector() -> int:
    """Both in one process: frames go from one to the other as they are, not through the middleware."""
    from starpos_common.node_main import run

    def make_nodes():
        from starpos_camera.camera import CameraNode
        from starpos_camera.detector import DetectorNode

        detector = DetectorNode()
        yield detector
        camera = CameraNode()
        camera.hand_to(detector)
        yield camera

    return run(make_nodes)

# SPDX-License-Identifier: Apache-2.0
"""Camera and detector in one process: the same stars, and no image through the middleware unless somebody wants it."""

import signal

import numpy as np
from sensor_msgs.msg import CameraInfo, Image

from starpos.detection import detect
from starpos.frames.reading import read_frame
from starpos.messages.stamp import stamp_to_unix
from starpos.messages.stars import message_to_stars
from starpos_interfaces.msg import Capture, StarArray

OK = 0


def test_the_stars_of_each_frame_come_without_its_image(start, listener, folder):
    infos, captures = (
        listener.hear(CameraInfo, "camera/camera_info"),
        listener.hear(Capture, "camera/capture"),
    )
    # the last, as the files are played from when somebody hears the stars
    stars = listener.hear(StarArray, "stars")
    node = start("camera_detector", f"files.path:={folder}", "cadence:=0.1", "focal_mm:=50")
    listener.wait(lambda: len(stars) == len(infos) == len(captures) == 2)
    for name, message, info, capture in zip(("0", "2"), stars, infos, captures, strict=True):
        frame = read_frame(folder / f"{name}.fits")
        want, got = detect(frame).stars, message_to_stars(message)
        np.testing.assert_array_equal(got.x, want.x)
        np.testing.assert_array_equal(got.covariance, want.covariance)
        assert message.header == info.header == capture.header
        assert abs(stamp_to_unix(message.header.stamp) - frame.mid_unix_s) < 2e-6
        assert (got.exposure_s, got.width, got.height) == (0.5, frame.width, frame.height)
    listener.wait_for_state("camera: Capture", OK, "are played")
    assert listener.wait_for_state("detector: Stars", OK)["frames"] == "2"
    status, out = node.end(signal.SIGINT, signal.SIGINT)
    assert status == 0 and "Traceback" not in out


def test_who_subscribes_to_the_images_gets_them_too(start, listener, folder):
    images, stars = listener.hear(Image, "camera/image_raw"), listener.hear(StarArray, "stars")
    (folder / "1.fits").unlink()
    node = start(
        "camera_detector", f"files.path:={folder}", "files.loop:=true", "cadence:=0.2", "focal_mm:=50"
    )
    listener.wait(lambda: len(images) >= 2 and len(stars) >= 2)
    first = read_frame(folder / "0.fits").pixels
    assert any(np.array_equal(np.frombuffer(i.data, np.uint16).reshape(first.shape), first) for i in images)
    assert node.end(signal.SIGTERM)[0] == 0


def test_a_camera_that_refuses_to_start_takes_the_detector_along(start):
    status, out = start("camera_detector").end()
    assert status == 1 and out.count("\n") == 1 and "files.path" in out

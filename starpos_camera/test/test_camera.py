# SPDX-License-Identifier: Apache-2.0
"""The node `camera` as a process of its own."""

import math
import signal

import cv2
import numpy as np
import pytest
from builtin_interfaces.msg import Time
from rclpy.qos import DurabilityPolicy, QoSProfile
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CameraInfo, Image
from sensor_msgs.srv import SetCameraInfo
from std_msgs.msg import Header

from starpos.detection import detect
from starpos.frames.exposure import UNKNOWN_LATENCY_S
from starpos.frames.reading import read_frame
from starpos.instrument import instrument_file
from starpos.instrument.camera import Camera
from starpos.messages.camera import message_to_camera, message_to_frame
from starpos.messages.stamp import stamp_to_unix
from starpos.simulation.scene import expose
from starpos.sky.catalogue import load_catalogue
from starpos_camera.camera import CameraNode
from starpos_common.messages import camera_to_message
from starpos_interfaces.msg import Capture, Pulse
from starpos_interfaces.srv import SetCapture
from starpos_testing.lacking import require
from starpos_testing.nodes import refusal
from starpos_testing.skies import raws

SMALL = ("source:=simulated", "focal_mm:=50", "simulated.width:=640", "simulated.height:=480")
OK, WARN, ERROR = 0, 1, 2
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


def hear_all(listener):
    """Lists of the images, the intrinsics and the captures to come."""
    captures = listener.hear(Capture, "camera/capture")
    infos = listener.hear(CameraInfo, "camera/camera_info")
    # the last, as files are played from when somebody hears the images
    return listener.hear(Image, "camera/image_raw"), infos, captures


def test_what_a_cameras_own_clock_is_off_goes_with_its_frames(start, listener, tmp_path):
    require("exifread")
    jpeg = cv2.imencode(".jpg", np.full((64, 96), 30, np.uint8))[1].tobytes()
    (tmp_path / "a.jpg").write_bytes(raws.with_exif(jpeg))
    _, _, captures = hear_all(listener)
    start("camera", f"files.path:={tmp_path}/*.jpg", "files.exif:=true", "files.exif_utc_offset:=1.0")
    listener.wait(lambda: captures)
    told = captures[0]
    assert (told.stamp_source, told.clock_stddev, told.exposure) == (Capture.EXIF, 60.0, 0.5)
    # whole seconds, and the unknown shutter
    assert told.stamp_stddev == pytest.approx(math.hypot(1 / math.sqrt(12), UNKNOWN_LATENCY_S), abs=1e-4)
    assert stamp_to_unix(told.header.stamp) == pytest.approx(1793642400.0 - 3600 + 0.75)


def set_capture(listener, exposure=math.nan, gain=math.nan, cadence=math.nan):
    request = SetCapture.Request(exposure=exposure, gain=gain, cadence=cadence)
    return listener.call(SetCapture, "camera/set_capture", request)


def test_plays_files_and_says_which_one_is_broken(start, listener, folder):
    images, infos, captures = hear_all(listener)
    node = start("camera", f"files.path:={folder}", "cadence:=0.1", "focal_mm:=50")
    listener.wait(lambda: len(images) == 2 and len(infos) == 2 and len(captures) == 2)
    for k, image, info, capture in zip((0, 2), images, infos, captures, strict=True):
        want, got = read_frame(folder / f"{k}.fits"), message_to_frame(image)
        np.testing.assert_array_equal(got.pixels, want.pixels)
        assert image.encoding == "mono16" and image.header.frame_id == "starpos_camera_optical_frame"
        assert got.mid_unix_s == pytest.approx(want.mid_unix_s, abs=2e-6)
        assert image.header == info.header == capture.header
        assert (capture.exposure, capture.stamp_source) == (0.5, Capture.FILE)
        assert message_to_camera(info) == Camera.from_focal(640, 480, 7812.5)
    state = listener.wait_for_state("camera: Capture", OK, "are played")
    assert (state["frames"], state["failed"], state["stamp from"]) == ("2", "1", "file")
    assert state["shutter"] == "global"

    later = listener.hear(CameraInfo, "camera/camera_info", LATCHED)
    # Though no frame comes any more.
    listener.wait(lambda: infos[-1] in later)

    assert "own exposure" in set_capture(listener, exposure=1.0).message
    assert "own gain" in set_capture(listener, gain=3.0).message
    changed = set_capture(listener, exposure=0.0, gain=0.0, cadence=2.0)
    assert changed.success and "cadence 2 s" in changed.message

    status, out = node.end(signal.SIGINT, signal.SIGINT)
    assert status == 0 and "Traceback" not in out
    assert out.count("1.fits") == 1 and len(out.splitlines()) <= 5


def test_a_folder_that_comes_later_is_a_warning_and_an_error_once_somebody_listens(
    start, listener, tmp_path, folder
):
    later = tmp_path / "later"
    node = start("camera", f"files.path:={later}", "cadence:=0.1")
    listener.wait_for_state("camera: Capture", WARN, f"{later}: there are no frames here")
    images, _, _ = hear_all(listener)
    listener.wait_for_state("camera: Capture", ERROR, "no frames here")
    later.mkdir()
    (folder / "0.fits").rename(later / "0.fits")
    listener.wait(lambda: images)
    status, out = node.end(signal.SIGTERM)
    assert status == 0 and out.count("no frames here") == 1


def test_simulated_sky_is_live_and_its_stars_are_where_starpos_says(start, listener, scene):
    images, infos, captures = hear_all(listener)
    node = start("camera", *SMALL, "cadence:=0.5")
    listener.wait(lambda: len(images) >= 3 and captures and infos)
    now = listener.node.get_clock().now().nanoseconds * 1e-9
    capture = captures[0]
    assert capture.stamp_source == Capture.SIMULATED and capture.exposure == 0.5
    assert (capture.shutter_known, capture.readout, capture.readout_stddev) == (True, 0.0, 0.0)
    frame = message_to_frame(images[0])
    assert 0 < now - frame.mid_unix_s < 30
    stars = detect(frame).stars
    start_s = frame.mid_unix_s - capture.exposure / 2
    truth = expose(scene, load_catalogue(), start_s, capture.exposure, np.random.default_rng(9)).middle
    away = np.hypot(stars.x[:8, None] - truth[:, 0], stars.y[:8, None] - truth[:, 1]).min(1)
    assert away.max() < 0.3
    steps = np.diff([stamp_to_unix(image.header.stamp) for image in images])
    assert np.all(steps > 0)

    assert set_capture(listener, exposure=0.25, cadence=0.4).success
    listener.wait(lambda: captures[-1].exposure == 0.25)
    assert "exposure 0.25 s, gain nan, cadence 0.4 s" in set_capture(listener).message
    assert "longer than `cadence`" in set_capture(listener, exposure=2.0).message
    assert "no gain" in set_capture(listener, gain=2.0).message
    assert "must be a number from 1e-06 to 3600 s" in set_capture(listener, exposure=-1.0).message
    # What the service sets, the parameters show, and the other way round.
    assert not listener.set("camera", cadence=0.1).successful
    assert listener.set("camera", **{"simulated.azimuth": 90.0, "exposure": 0.1}).successful
    listener.wait(lambda: captures[-1].exposure == 0.1)
    assert listener.set("camera", readout=-0.03, readout_stddev=0.001).successful
    listener.wait(lambda: captures[-1].readout == -0.03)
    assert captures[-1].readout_stddev == 0.001
    assert not listener.set("camera", source="files").successful
    status, out = node.end(signal.SIGTERM)
    assert status == 0 and "taking frames of 640 x 480 px." in out and len(out.splitlines()) == 1


def test_sim_time_drives_the_simulated_sky(start, listener):
    images, _, _ = hear_all(listener)
    clock = listener.node.create_publisher(Clock, "/clock", 10)
    node = start("camera", *SMALL, "cadence:=2.0", "use_sim_time:=true")
    listener.wait_for_state("camera: Capture", WARN, "no /clock")
    moment = Clock()
    moment.clock.sec = 1793642400

    def later():
        moment.clock.sec += 1
        clock.publish(moment)
        return len(images) >= 3

    listener.wait(later)
    stamps = [stamp_to_unix(image.header.stamp) for image in images]
    # the clock moves in whole seconds, and the exposure of 0.5 s has just ended
    assert all((t + 0.25) % 1 == 0 and 1793642400 < t <= moment.clock.sec for t in stamps)
    # one that came late, the next is on time again: two of three are apart by the cadence
    assert stamps[-1] - stamps[0] > 2.0 * (len(stamps) - 2)
    assert node.end(signal.SIGINT)[0] == 0


def test_a_cadence_that_is_too_short_is_reported(start, listener):
    size = ("simulated.width:=3000", "simulated.height:=3000")
    node = start("camera", *SMALL, *size, "exposure:=0.01", "cadence:=0.01")
    listener.wait_for_state("camera: Capture", WARN, "longer than the cadence of 0.01 s")
    assert node.end(signal.SIGINT)[0] == 0


def test_set_camera_info_is_validated_kept_and_there_after_a_restart(start, listener, tmp_path):
    path = tmp_path / "config" / "camera.yaml"
    options = (*SMALL, "cadence:=0.5", f"calibration_url:=file://{path}")
    _, infos, _ = hear_all(listener)
    node = start("camera", *options)
    listener.wait(lambda: infos)
    camera = Camera(
        width=640,
        height=480,
        fx=7800.0,
        fy=7801.0,
        cx=320.5,
        cy=239.5,
        distortion=(0.1, -0.2, 1e-4, 2e-4, 0.0),
    )
    other_size = Camera.from_focal(320, 240, 7800.0)
    crooked = camera_to_message(camera, "")
    crooked.k[0] = math.nan
    for wrong, sentence in ((camera_to_message(other_size, ""), "320 x 240"), (crooked, "NaN")):
        answer = listener.call(
            SetCameraInfo, "camera/set_camera_info", SetCameraInfo.Request(camera_info=wrong)
        )
        assert not answer.success and sentence in answer.status_message
    assert not path.exists()
    request = SetCameraInfo.Request(camera_info=camera_to_message(camera, ""))
    answer = listener.call(SetCameraInfo, "camera/set_camera_info", request)
    assert answer.success and str(path) in answer.status_message
    listener.wait(lambda: message_to_camera(infos[-1]) == camera)
    assert instrument_file.read_camera(path) == camera
    assert [p.name for p in path.parent.iterdir()] == ["camera.yaml"]
    status, out = node.end(signal.SIGINT)
    assert status == 0 and "there is no calibration yet" in out
    said = [line for line in out.splitlines() if "set_camera_info:" in line]
    assert [line.split("]")[0] for line in said] == ["[WARN", "[WARN", "[INFO"]
    assert all(line.count("set_camera_info:") == 1 for line in said)

    infos = listener.hear(CameraInfo, "camera/camera_info")
    node = start("camera", *options)
    listener.wait(lambda: infos)
    assert message_to_camera(infos[0]) == camera
    assert node.end(signal.SIGINT)[0] == 0


def test_a_calibration_that_cannot_be_written_holds_for_the_session(start, listener, tmp_path):
    (tmp_path / "file").write_text("")
    _, infos, _ = hear_all(listener)
    node = start("camera", *SMALL, "cadence:=0.5", f"calibration_url:={tmp_path}/file/camera.yaml")
    camera = Camera.from_focal(640, 480, 1234.0)
    request = SetCameraInfo.Request(camera_info=camera_to_message(camera, ""))
    answer = listener.call(SetCameraInfo, "camera/set_camera_info", request)
    assert not answer.success and "cannot be written" in answer.status_message
    assert "this session only" in answer.status_message
    listener.wait(lambda: infos and message_to_camera(infos[-1]) == camera)
    assert node.end(signal.SIGINT)[0] == 0


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ((), "files.path must name a folder"),
        (("source:=webcam",), "source must be one of files, simulated"),
        (("frame_id:='a b'",), "frame_id must be a frame's name, not empty, without blanks"),
        (("source:=simulated", "exposure:=6"), "must not be longer than `cadence`"),
        (("source:=simulated", "simulated.latitude:=91"), "from -90 to 90 deg"),
        (("source:=simulated", "calibration_url:=http://x/y.yaml"), "file:///"),
        (("source:=simulated", "calibration_url:=/etc/hostname"), "calibration file"),
        (("files.path:=/x", "exposure:=1.0"), "own exposure"),
        (
            ("indi.clock_stddev:=0.0",),
            "indi.clock_stddev must be a number from 1e-09 to 60 s, or nan for unset",
        ),
        (("alpaca.clock_stddev:=0.0",), "alpaca.clock_stddev must be a number from 1e-09 to 60 s, or nan"),
    ],
)
def test_bad_parameters_are_refused(options, sentence):
    assert sentence in refusal(CameraNode, *options)


def test_unset_parameters_are_nan_in_ros_too_and_pulses_are_heard(start, listener):
    node = start("camera", *SMALL, "pulses:=true")
    # the shutter's edges are heard too, and the receiver's seconds are not taken for any
    edges = listener.node.create_publisher(Pulse, "pulses", 10)
    listener.wait(edges.get_subscription_count)
    for which in (Pulse.SHUTTER, Pulse.PPS, Pulse.SHUTTER):
        edges.publish(Pulse(header=Header(stamp=Time(sec=1_700_000_000)), input=which))
    listener.values_of("camera: Capture", lambda values: values["edges of the shutter"] == "2")
    assert listener.set("camera", exposure=1.0).successful
    assert listener.set("camera", exposure=math.nan).successful
    assert not listener.set("camera", exposure=math.inf).successful
    assert node.end(signal.SIGTERM)[0] == 0

# SPDX-License-Identifier: Apache-2.0
"""The source `video` with OpenCV's real V4L2 backend, which talks to an emulated driver instead of the kernel."""

import json
import math
import os
import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from attempts import attempt, made, values

from starpos_camera.sources.source import CaptureError, CaptureSettings
from starpos_camera.sources.video import Video, _from_jpeg
from starpos_interfaces.msg import Capture
from starpos_testing.lacking import lacks
from starpos_testing.patience import WAIT_S

HERE = Path(__file__).parent
# The emulated camera's.
PERIOD_S, TRANSFER_S = 0.04, 0.01


@pytest.fixture(scope="module")
def library(tmp_path_factory):
    if not shutil.which("gcc"):
        lacks("gcc")
    path = tmp_path_factory.mktemp("v4l2") / "emulated.so"
    subprocess.run(
        ["gcc", "-shared", "-fPIC", "-o", str(path), str(HERE / "v4l2_emulated.c"), "-ldl"], check=True
    )
    return path


@pytest.fixture
def session(library, tmp_path):
    def session(name, *behaviour, **given):
        for word in ("plugged", *behaviour):
            (tmp_path / word).touch()
        parameters = {key.replace("__", "."): value for key, value in given.items()}
        done = subprocess.run(
            [sys.executable, str(HERE / "v4l2_sessions.py"), name, json.dumps(parameters)],
            check=False,
            env=os.environ | {"LD_PRELOAD": str(library), "STARPOS_V4L2": str(tmp_path)},
            capture_output=True,
            text=True,
            timeout=WAIT_S,
        )
        assert done.returncode == 0, done.stderr
        return json.loads(done.stdout.splitlines()[-1])

    return session


@pytest.mark.parametrize(
    ("letters", "kind", "pattern"),
    [("YUYV", "uint8", ""), ("GREY", "uint8", ""), ("Y16", "uint16", ""), ("RGGB", "uint8", "rggb")],
)
def test_the_sensors_pixels_in_every_format(session, letters, kind, pattern):
    (shot,) = session("frames", video__format=letters, video__width=64, video__height=48)
    assert shot["pixels_good"]
    assert (shot["size"], shot["type"], shot["pattern"]) == ([64, 48], kind, pattern)
    # It is automatic, and no longer than the period.
    assert shot["exposure_s"] is None
    assert shot["stddev_s"] == pytest.approx(2 * PERIOD_S / math.sqrt(12))
    # its rows are read within a period, from either end
    assert shot["readout_stddev_s"] == pytest.approx(PERIOD_S / math.sqrt(3))


def test_frames_are_exposed_after_they_are_asked_for_and_stamped_as_wide_as_is_not_known(session):
    taken = session("frames", options={"settings": [[0.005, None]] * 2 + [[0.03, None]] * 2})
    assert [shot["exposure_s"] for shot in taken] == pytest.approx([0.005, 0.005, 0.03, 0.03])
    for shot in taken:
        assert shot["began_s"] >= 0 and shot["stamp"] == Capture.HARDWARE
        assert shot["stddev_s"] == pytest.approx((PERIOD_S + shot["exposure_s"]) / math.sqrt(12))
        assert abs(shot["mid_s"] - shot["began_s"] - shot["exposure_s"] / 2) < math.sqrt(3) * shot["stddev_s"]


@pytest.mark.parametrize("clock", ["", "realtime"])
def test_a_known_lag_makes_the_stamp_sharp(session, clock):
    settings = {"settings": [[0.03, None]] * 2}
    taken = session("frames", *clock.split(), video__lag=0.015, command_lag_stddev=0.001, options=settings)
    for shot in taken:
        assert (shot["stamp"], shot["stddev_s"]) == (Capture.HARDWARE, 0.001)
        assert shot["mid_s"] == pytest.approx(shot["began_s"] + 0.015, abs=0.004)
        assert shot["began_s"] >= 0


def test_without_stamps_the_time_of_the_read_counts(session):
    for shot in session("frames", "unstamped", options={"settings": [[0.03, None]] * 3}):
        assert shot["stamp"] == Capture.DRIVER and shot["began_s"] >= 0
        assert abs(shot["mid_s"] - shot["began_s"] - 0.015) < math.sqrt(3) * shot["stddev_s"]


@pytest.mark.parametrize("stamps", [(), ("unstamped",)])
def test_a_camera_that_is_slower_in_the_dark_than_it_says(session, stamps):
    for shot in session("frames", "dark", "automatic", *stamps, options={"settings": [[None, None]] * 2}):
        assert shot["began_s"] >= 0 and shot["exposure_s"] is None
        # A busy machine makes it slower still.
        assert 0.9 * 2 * 0.12 / math.sqrt(12) < shot["stddev_s"] < 0.5
        assert abs(shot["mid_s"] - shot["began_s"] - 0.06) < math.sqrt(3) * shot["stddev_s"]


def test_what_the_camera_makes_of_settings_is_told(session):
    long, strong, too_strong = session(
        "frames", options={"settings": [[0.5, None], [None, 20.0], [None, 5000.0]]}
    )
    assert long["exposure_s"] == 0.1 and "exposes for 0.1 s, not for 0.5 s" in long["remark"]
    assert strong["remark"] == ""
    assert "its gain is 1000, though 5000 was set" in too_strong["remark"]
    (shot,) = session("frames", "automatic", options={"settings": [[0.02, None]]})
    assert "leave `exposure` unset" in shot["error"]


def test_sizes_and_formats_that_it_has_not_are_refused(session):
    (shot,) = session("frames", video__width=64, video__height=64)
    assert "frames of 64 x 48 px" in shot["error"]
    (shot,) = session("frames", video__format="NV12")
    assert "it sends" in shot["error"] and "NV12" in shot["error"]


def test_short_frames_are_refused_where_opencv_tells(session, record_property):
    (shot,) = session("frames", "short", video__format="RGGB", video__width=64, video__height=48)
    assert "3056 bytes instead of 3072" in shot["error"]
    record_property("fault", "V4L2 (emulated driver): short frames of a mosaic")
    record_property("result", "refused; of YUYV, GREY, Y16 OpenCV does not tell, the kernel drops them")


def test_the_camera_is_unplugged_and_comes_back(session, record_property):
    before, gone, still_gone, back, pulled, again = session("unplugged")
    assert before["pixels_good"] and back["pixels_good"] and again["pixels_good"]
    assert "check its plug" in gone["error"] and "check its plug" in pulled["error"]
    assert "cannot be opened" in still_gone["error"]
    assert back["began_s"] >= 0 and again["began_s"] >= 0
    record_property("fault", "V4L2 (emulated driver): unplugged, also within an exposure, and back")
    record_property(
        "result", f"noticed after {pulled['took_s']:.1f} s; a frame {again['took_s']:.1f} s after it was back"
    )


def test_a_camera_that_gives_nothing_is_given_up_in_time(session, monkeypatch):
    # In seconds; 10 by default.
    monkeypatch.setenv("OPENCV_VIDEOIO_V4L_SELECT_TIMEOUT", "1")
    (shot,) = session("frames", "frozen")
    assert "no frame" in shot["error"]


def test_a_jpeg_is_whole_or_none():
    picture = np.add.outer(np.arange(48), 3 * np.arange(64)).astype(np.uint8)
    data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 100])[1].tobytes() + bytes(9)
    assert abs(_from_jpeg(cv2, data, 64, 48).astype(int) - picture).max() <= 3
    for broken, size in ((data[:-500], (64, 48)), (data[:0], (64, 48)), (data, (48, 64))):
        with pytest.raises(CaptureError, match="no whole JPEG"):
            _from_jpeg(cv2, broken, *size)


def test_what_is_no_camera_or_cannot_be_is_refused():
    def refusal(device, **changes):
        return Video.refusal(values("video", video__device=device, **changes), CaptureSettings(0.1, 3.0, 5.0))

    for other in ("", "rtsp://camera/1", "http://127.0.0.1/a.avi", "a.avi"):
        assert "of this machine" in refusal(other)
    assert "video.format must be one of" in refusal("/dev/video0", video__format="H264")
    assert "together" in refusal("0", video__width=640)
    assert refusal("0", video__format="Y16") is None


def test_a_camera_that_is_not_there_is_said():
    source = made(values("video", video__device="/dev/v4l/by-id/none"))
    assert not source.waits_for_listener and "plug it in" in source.lacking()
    assert "cannot be opened as a camera" in attempt(source)
    assert made(values("video", video__device="7")).hardware_id == "/dev/video7"

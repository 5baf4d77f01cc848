# SPDX-License-Identifier: Apache-2.0
"""The source `video` with real video files through OpenCV's FFmpeg."""

import math
import struct

import attempts
import cv2
import numpy as np
import pytest
from attempts import made
from sensor_msgs.msg import Image

from starpos.errors import FrameError
from starpos_camera.sources.source import CaptureSettings, SourceEnded
from starpos_camera.sources.video import Video
from starpos_interfaces.msg import Capture

SETTINGS = CaptureSettings(None, None, 5.0)
START, START_S = "2026-11-02T18:00:00.00", 1793642400.0
RATE, FRAMES = 25.0, 5
WIDTH, HEIGHT = 64, 48
NOISE = np.random.default_rng(5).integers(0, 65536, (FRAMES, HEIGHT, WIDTH)).astype(np.uint16)
PICTURES = (
    NOISE // 4 + np.add.outer(700 * np.arange(HEIGHT), 100 * np.arange(WIDTH)).astype(np.uint16)[None] // 4
)


def write(path, letters, pictures, depth=cv2.CV_8U):
    colour = pictures.ndim == 4
    options = [cv2.VIDEOWRITER_PROP_IS_COLOR, int(colour)]
    if depth != cv2.CV_8U:
        options += [cv2.VIDEOWRITER_PROP_DEPTH, depth]
    code = cv2.VideoWriter_fourcc(*letters)
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, code, RATE, (WIDTH, HEIGHT), options)
    assert writer.isOpened()
    for picture in pictures:
        writer.write(picture)
    writer.release()
    return path


@pytest.fixture
def film(tmp_path):
    return write(tmp_path / "film.mkv", "FFV1", (PICTURES >> 8).astype(np.uint8))


def values(path, **changes):
    return attempts.values("video", **{"video__device": str(path), "video__start": START} | changes)


def make(path, **changes):
    return made(values(path, **changes), SETTINGS)


def play(source, count):
    return attempts.play(source, count, SETTINGS)


def test_every_frame_as_it_was_written_at_the_time_of_its_place(film):
    source = make(film)
    assert source.waits_for_listener
    *taken, end, still_ended = play(source, FRAMES + 2)
    for k, exposure in enumerate(taken):
        np.testing.assert_array_equal(exposure.frame.pixels, PICTURES[k] >> 8)
        assert exposure.frame.mid_unix_s == pytest.approx(START_S + (k + 0.5) / RATE, abs=1e-3)
        assert exposure.stamp_source == Capture.FILE and exposure.frame.exposure_s is None
        assert exposure.frame.stamp_stddev_s == pytest.approx(math.hypot(1 / RATE, 0.01) / math.sqrt(12))
    assert isinstance(end, SourceEnded) and isinstance(still_ended, SourceEnded)


@pytest.mark.skipif(cv2.__version__ < "4.7", reason="OpenCV before 4.7 neither writes nor reads 16-bit video")
def test_sixteen_bits_stay_sixteen(tmp_path):
    path = write(tmp_path / "deep.mkv", "FFV1", PICTURES, cv2.CV_16U)
    for k, exposure in enumerate(play(make(path), FRAMES)):
        np.testing.assert_array_equal(exposure.frame.pixels, PICTURES[k])


def test_colour_and_motion_jpeg(tmp_path):
    pictures = np.zeros((FRAMES, HEIGHT, WIDTH, 3), np.uint8)
    # Blue, green, red, above black.
    pictures[:, : HEIGHT // 2] = 20, 120, 220
    frame = play(make(write(tmp_path / "colour.avi", "MJPG", pictures)), 1)[0].frame
    assert abs(frame.pixels.astype(int) - pictures[0]).mean() < 3


@pytest.mark.parametrize(("name", "letters"), [("cut.mkv", "FFV1"), ("cut.avi", "FFV1"), ("cut.avi", "MJPG")])
def test_a_file_that_breaks_off_gives_its_whole_frames_and_no_other(tmp_path, name, letters, record_property):
    path = write(tmp_path / name, letters, (PICTURES >> 8).astype(np.uint8))
    whole = [exposure.frame.pixels for exposure in play(make(path), FRAMES)]
    data = path.read_bytes()
    path.write_bytes(data[: len(data) * 7 // 10])
    taken = play(make(path), FRAMES + 1)
    frames = [exposure.frame.pixels for exposure in taken if not isinstance(exposure, Exception)]
    assert 2 <= len(frames) < FRAMES
    for k, pixels in enumerate(frames):
        np.testing.assert_array_equal(pixels, whole[k])
    assert "breaks off after" in str(taken[len(frames)]) and isinstance(taken[-1], SourceEnded)
    record_property("fault", "video file: cut off")
    record_property("result", f"{len(frames)} of {FRAMES} frames, all whole; then the sentence")


def test_the_disk_goes_and_comes_back(film, record_property):
    source = make(film)
    first = source.capture(SETTINGS)
    away = film.rename(film.with_suffix(".away"))
    gone, still_gone = play(source, 2)
    assert "it is not there" in str(gone) and "it is not there" in str(still_gone) and source.lacking()
    away.rename(film)
    assert source.lacking() is None
    *later, end = play(source, FRAMES)
    for k, exposure in enumerate([first, *later]):
        np.testing.assert_array_equal(exposure.frame.pixels, PICTURES[k] >> 8)
        assert exposure.frame.mid_unix_s == pytest.approx(START_S + (k + 0.5) / RATE, abs=1e-3)
    assert isinstance(end, SourceEnded)
    record_property("fault", "video file: the disk is gone and comes back")
    record_property("result", "said; goes on with the next frame, at its time")


@pytest.mark.parametrize(
    "text", [b"", b"no video", b"\x1aE\xdf\xa3" + bytes(100), b"RIFF\xff\xff\xff\xffAVI LIST", b"RIFF"]
)
def test_what_is_no_video_is_one_sentence(tmp_path, text):
    path = tmp_path / "night.avi"
    path.write_bytes(text)
    (error,) = play(make(path), 1)
    assert isinstance(error, FrameError) and str(path) in str(error)


def test_a_playlist_leads_to_no_other_file_and_no_network(tmp_path, film):
    for target in (f"file://{film}", "http://127.0.0.1:1/a.ts"):
        path = tmp_path / "list.mp4"
        path.write_text(f"#EXTM3U\n#EXT-X-TARGETDURATION:5\n#EXTINF:5,\n{target}\n#EXT-X-ENDLIST\n")
        (error,) = play(make(path), 1)
        assert isinstance(error, FrameError)


def test_an_absurd_header_is_refused(tmp_path):
    path = write(tmp_path / "huge.avi", "FFV1", (PICTURES >> 8).astype(np.uint8))
    data = bytearray(path.read_bytes())
    # BITMAPINFOHEADER
    at = data.index(b"strf") + 8
    # FFmpeg itself refuses more.
    struct.pack_into("<ii", data, at + 4, 15000, 14000)
    path.write_bytes(data)
    (error,) = play(make(path), 1)
    assert "15000 x 14000 px" in str(error) and "are no video" in str(error)


@pytest.mark.parametrize(
    "start", ["", "18:00", "2026-11-02", "2026-11-02T18:00:00+01:00", "2026-13-02T18:00:00"]
)
def test_a_file_without_a_start_is_refused(start):
    assert "set video.start" in Video.refusal(values("a.mkv", video__start=start), SETTINGS)


def test_what_cannot_be_done_is_refused():
    def refusal(path, settings=SETTINGS, **changes):
        return Video.refusal(values(path, **changes), settings)

    for stream in ("", "rtsp://camera/1", "http://127.0.0.1/a.avi"):
        assert "of this machine" in refusal(stream)
    assert "a video file" in refusal("notes.txt")
    assert "leave `exposure`" in refusal("a.avi", CaptureSettings(0.1, None, 5.0))
    assert "leave `exposure`" in refusal("a.avi", CaptureSettings(None, 3.0, 5.0))
    assert "video.format must be one of" in refusal("/dev/video0", video__format="H264")
    assert "together" in refusal("0", video__width=640)
    assert refusal("0", CaptureSettings(0.1, 3.0, 5.0), video__format="Y16") is None


def test_a_camera_that_is_not_there_is_said():
    source = make("/dev/v4l/by-id/none")
    assert not source.waits_for_listener and "plug it in" in source.lacking()
    (error,) = play(source, 1)
    assert "cannot be opened as a camera" in str(error)
    assert make("7").hardware_id == "/dev/video7"


def test_the_node_plays_a_film(film, start, listener):
    images = listener.hear(Image, "camera/image_raw")
    start("camera", "source:=video", f"video.device:={film}", f"video.start:='{START}'", "cadence:=0.2")
    listener.wait(lambda: len(images) == FRAMES)
    assert [image.encoding for image in images] == ["mono8"] * FRAMES
    listener.wait_for_state("camera: Capture", 0, f"all {FRAMES} frames")

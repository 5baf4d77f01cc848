# SPDX-License-Identifier: Apache-2.0
"""Calibration files: what camera_calibration writes, what is refused, and that none is ever half-written."""

import threading

import pytest

from starpos.camera import Camera
from starpos.errors import InstrumentError
from starpos_camera import calibration

CAMERA = Camera(640, 480, 7800.5, 7801.25, 320.1, 239.7, (0.1, -0.2, 1e-4, -2e-4, 0.05))
# as camera_calibration's `commit` writes it
WRITTEN_BY_ROS = """\
image_width: 640
image_height: 480
camera_name: narrow_stereo
camera_matrix:
  rows: 3
  cols: 3
  data: [7800.5, 0., 320.1, 0., 7801.25, 239.7, 0., 0., 1.]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [0.1, -0.2, 0.0001, -0.0002, 0.05]
rectification_matrix:
  rows: 3
  cols: 3
  data: [1., 0., 0., 0., 1., 0., 0., 0., 1.]
projection_matrix:
  rows: 3
  cols: 4
  data: [7800.5, 0., 320.1, 0., 0., 7801.25, 239.7, 0., 0., 0., 1., 0.]
"""


def test_reads_what_ros_writes(tmp_path):
    path = tmp_path / "camera.yaml"
    path.write_text(WRITTEN_BY_ROS)
    assert calibration.read(path) == CAMERA


def test_reads_what_it_writes_even_into_a_new_folder(tmp_path):
    path = tmp_path / "new" / "camera.yaml"
    calibration.write(path, CAMERA, "camera")
    assert calibration.read(path) == CAMERA
    assert [p.name for p in path.parent.iterdir()] == ["camera.yaml"]


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ("plumb_bob", "equidistant", "equidistant"),
        ("image_width: 640", "image_width: 640.5", "whole numbers"),
        ("image_width: 640", "image_width: 0", "at least 1"),
        ("camera_matrix", "matrix", "camera_matrix"),
        ("-0.0002, 0.05]", "-0.0002]", "4 values for 5"),
        ("[7800.5, 0., 320.1", "[7800.5, 3., 320.1", "skew"),
        ("[7800.5, 0., 320.1", "[.nan, 0., 320.1", "not finite"),
        ("[7800.5, 0., 320.1", "[-1.0, 0., 320.1", "positive"),
        ("camera_name: narrow_stereo", "camera_name: !!python/object/apply:os.getcwd []", "cannot be read"),
        ("rows: 1", "rows: [", "cannot be read"),
    ],
)
def test_bad_files_are_refused_in_a_sentence(tmp_path, old, new, sentence):
    path = tmp_path / "camera.yaml"
    path.write_text(WRITTEN_BY_ROS.replace(old, new, 1))
    with pytest.raises(InstrumentError, match=sentence) as caught:
        calibration.read(path)
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize("content", [b"", b"[1, 2]", b"\xff\xfe", b" " * (1 << 21)])
def test_what_is_no_calibration_at_all(tmp_path, content):
    path = tmp_path / "camera.yaml"
    path.write_bytes(content)
    with pytest.raises(InstrumentError):
        calibration.read(path)


def test_urls():
    assert str(calibration.path_of("file:///a/b%20c.yaml")) == "/a/b c.yaml"
    assert str(calibration.path_of("/a/b.yaml")) == "/a/b.yaml"
    for url in ("http://a/b.yaml", "package://a/b.yaml", "file://host/b.yaml"):
        with pytest.raises(InstrumentError, match="file:///"):
            calibration.path_of(url)


def test_a_reader_never_sees_half_a_file(tmp_path):
    path = tmp_path / "camera.yaml"
    other = Camera(1234, 567, 1e3, 1e3, 1.0, 2.0)
    calibration.write(path, CAMERA, "camera")

    def write():
        for _ in range(20):
            calibration.write(path, other, "camera")
            calibration.write(path, CAMERA, "camera")

    writer = threading.Thread(target=write)
    writer.start()
    while writer.is_alive():
        assert calibration.read(path) in (CAMERA, other)
    writer.join()


def test_where_it_cannot_be_written_the_old_file_stays_and_nothing_is_left(tmp_path):
    path = tmp_path / "camera.yaml"
    path.mkdir()
    with pytest.raises(InstrumentError, match="cannot be written"):
        calibration.write(path, CAMERA, "camera")
    assert [p.name for p in tmp_path.iterdir()] == ["camera.yaml"]

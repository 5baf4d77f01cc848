# SPDX-License-Identifier: Apache-2.0
"""Calibration files: what camera_calibration writes, what is refused, and that none is ever half-written."""

import os
import threading
from dataclasses import replace

import cv2
import numpy as np
import pytest
import yaml

from starpos.errors import InstrumentError
from starpos.instrument import instrument_file
from starpos.instrument.camera import Camera

CAMERA = Camera(
    width=640,
    height=480,
    fx=7800.5,
    fy=7801.25,
    cx=320.1,
    cy=239.7,
    distortion=(0.1, -0.2, 1e-4, -2e-4, 0.05),
)
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
    assert instrument_file.read_camera(path) == CAMERA


def test_reads_and_writes_a_fisheye(tmp_path):
    path, four = tmp_path / "camera.yaml", "[-0.04, 0.0005, 0.00001, -0.000002]"
    written = WRITTEN_BY_ROS.replace("plumb_bob", "equidistant").replace("cols: 5", "cols: 4")
    path.write_text(written.replace("[0.1, -0.2, 0.0001, -0.0002, 0.05]", four))
    fisheye = replace(CAMERA, model="equidistant", distortion=(-0.04, 5e-4, 1e-5, -2e-6))
    assert instrument_file.read_camera(path) == fisheye
    instrument_file.write_camera(path, fisheye, "camera")
    assert instrument_file.read_camera(path) == fisheye and "cols: 4" in path.read_text()


def test_a_decentred_fisheye_has_colmaps_name_and_order(tmp_path):
    path = tmp_path / "camera.yaml"
    decentred = replace(CAMERA, model="equidistant", distortion=(-0.04, 5e-4, 1e-5, -2e-6, 1e-3, 2e-3))
    instrument_file.write_camera(path, decentred, "camera")
    told = yaml.safe_load(path.read_text())
    assert told["distortion_model"] == "thin_prism_fisheye"
    assert told["distortion_coefficients"]["data"] == [-0.04, 5e-4, 1e-3, 2e-3, 1e-5, -2e-6, 0, 0]
    assert instrument_file.read_camera(path) == decentred


def test_reads_and_writes_a_rational_lens(tmp_path):
    path, eight = tmp_path / "camera.yaml", (0.5, -2.7, 4e-4, -2e-4, 1.6, 0.4, -2.5, 1.5)
    written = WRITTEN_BY_ROS.replace("plumb_bob", "rational_polynomial").replace("cols: 5", "cols: 8")
    path.write_text(written.replace("[0.1, -0.2, 0.0001, -0.0002, 0.05]", str(list(eight))))
    rational = replace(CAMERA, model="rational_polynomial", distortion=eight)
    assert instrument_file.read_camera(path) == rational
    instrument_file.write_camera(path, rational, "camera")
    assert instrument_file.read_camera(path) == rational and "cols: 8" in path.read_text()


def test_reads_what_it_writes_even_into_a_new_folder(tmp_path):
    path = tmp_path / "new" / "camera.yaml"
    instrument_file.write_camera(path, CAMERA, "camera")
    assert instrument_file.read_camera(path) == CAMERA
    assert [p.name for p in path.parent.iterdir()] == ["camera.yaml"]


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ("plumb_bob", "omni", "'omni' with 5 terms"),
        ("plumb_bob", "equidistant", "'equidistant' with 5 terms"),
        ("image_width: 640", "image_width: 640.5", "whole numbers"),
        ("image_width: 640", "image_width: 0", "at least 1"),
        ("camera_matrix", "matrix", "camera_matrix"),
        ("image_width: 640", "image_width: " + "9" * 400, "whole numbers"),
        ("plumb_bob", "[[[[[[[[a]]]]]]]]", "distortion model"),
        ("-0.0002, 0.05]", "-0.0002, 0.05, 0.1]", "6 terms"),
        ("[7800.5, 0., 320.1", "[7800.5, 3., 320.1", "skew"),
        ("[7800.5, 0., 320.1", "[.nan, 0., 320.1", "not finite"),
        ("[7800.5, 0., 320.1", "[-1.0, 0., 320.1", "positive"),
        ("camera_name: narrow_stereo", "camera_name: !!python/object/apply:os.getcwd []", "not a readable"),
        ("rows: 1", "rows: [", "not a readable"),
    ],
)
def test_bad_files_are_refused_in_a_sentence(tmp_path, old, new, sentence):
    path = tmp_path / "camera.yaml"
    path.write_text(WRITTEN_BY_ROS.replace(old, new, 1))
    with pytest.raises(InstrumentError, match=sentence) as caught:
        instrument_file.read_camera(path)
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)


def test_another_reader_finds_every_key_where_it_should_be(tmp_path):
    """OpenCV's parser, which wants its own first line; the comment says nothing to it."""
    path = tmp_path / "camera.yaml"
    instrument_file.write_camera(path, CAMERA, "camera", "sigma: fx 0.1\nimage_width: 5")
    file = cv2.FileStorage(
        "%YAML:1.0\n---\n" + path.read_text(), cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY
    )

    def matrix(name):
        node = file.getNode(name)
        data = node.getNode("data")
        shape = [int(node.getNode(n).real()) for n in ("rows", "cols")]
        return np.array([data.at(i).real() for i in range(data.size())]).reshape(shape)

    fx, fy, cx, cy = CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy
    k = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    np.testing.assert_array_equal(matrix("camera_matrix"), k)
    np.testing.assert_array_equal(matrix("distortion_coefficients"), [CAMERA.distortion])
    np.testing.assert_array_equal(matrix("rectification_matrix"), np.eye(3))
    np.testing.assert_array_equal(matrix("projection_matrix"), np.hstack([k, np.zeros((3, 1))]))
    assert (file.getNode("image_width").real(), file.getNode("image_height").real()) == (640, 480)
    assert file.getNode("distortion_model").string() == "plumb_bob"
    assert file.getNode("camera_name").string() == "camera"
    assert instrument_file.read_camera(path) == CAMERA


def test_a_file_is_parsed_up_to_64_kb_only(tmp_path):
    path = tmp_path / "camera.yaml"
    instrument_file.write_camera(path, CAMERA, "camera")
    whole = path.read_bytes()
    path.write_bytes(whole + b"#" * (64_000 - len(whole)))
    assert instrument_file.read_camera(path) == CAMERA
    path.write_bytes(whole + b"#" * (64_001 - len(whole)))
    with pytest.raises(InstrumentError, match="64001 bytes, and may have 64000"):
        instrument_file.read_camera(path)


def test_a_link_stays_one_when_a_calibration_is_written_through_it(tmp_path):
    (tmp_path / "store").mkdir()
    path = tmp_path / "camera.yaml"
    path.symlink_to("store/cam1.yaml")
    instrument_file.write_camera(path, CAMERA, "camera")
    other = Camera(width=1234, height=567, fx=1e3, fy=1e3, cx=611.0, cy=282.0)
    instrument_file.write_camera(path, other, "camera")
    assert path.is_symlink() and instrument_file.read_camera(tmp_path / "store" / "cam1.yaml") == other
    assert [p.name for p in (tmp_path / "store").iterdir()] == ["cam1.yaml"]


def test_a_pipe_is_not_waited_for(tmp_path):
    path = tmp_path / "camera.yaml"
    os.mkfifo(path)
    with pytest.raises(InstrumentError, match="no regular file"):
        instrument_file.read_camera(path)


@pytest.mark.parametrize("content", [b"", b"[1, 2]", b"\xff\xfe", b" " * (1 << 21)])
def test_what_is_no_calibration_at_all(tmp_path, content):
    path = tmp_path / "camera.yaml"
    path.write_bytes(content)
    with pytest.raises(InstrumentError):
        instrument_file.read_camera(path)


def test_a_reader_never_sees_half_a_file(tmp_path):
    path = tmp_path / "camera.yaml"
    other = Camera(width=1234, height=567, fx=1e3, fy=1e3, cx=611.0, cy=282.0)
    instrument_file.write_camera(path, CAMERA, "camera")

    def write():
        for _ in range(20):
            instrument_file.write_camera(path, other, "camera")
            instrument_file.write_camera(path, CAMERA, "camera")

    writer = threading.Thread(target=write)
    writer.start()
    while writer.is_alive():
        assert instrument_file.read_camera(path) in (CAMERA, other)
    writer.join()


def test_where_it_cannot_be_written_the_old_file_stays_and_nothing_is_left(tmp_path):
    path = tmp_path / "camera.yaml"
    path.mkdir()
    with pytest.raises(InstrumentError, match="cannot be written"):
        instrument_file.write_camera(path, CAMERA, "camera")
    assert [p.name for p in tmp_path.iterdir()] == ["camera.yaml"]

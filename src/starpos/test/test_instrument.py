# SPDX-License-Identifier: Apache-2.0
from itertools import pairwise

import numpy as np
import pytest

from starpos import camera_yaml
from starpos.camera import Camera
from starpos.errors import InstrumentError
from starpos.instrument import Calibration, Instrument, focal_px_of
from starpos.instrument_file import read, write

SIMPLE = "starpos_instrument: 1\ncamera: {focal_mm: 600, pixel_um: 6.4}\n"
FULL = """starpos_instrument: 1
camera: {width: 1392, height: 1040, fx: 5200.5, fy: 5201.5, cx: 700.25, cy: 520, distortion: [-0.1, 0.01, 1e-3, -2e-3, 0]}
misalignment_deg: [0.1, -0.2, 30]
calibration_stddev_arcsec: [1, 2, 3]
link_to_camera: [[0, 1, 0], [-1, 0, 0], [0, 0, 1]]
tilt_noise_deg: 0.002
clock_stddev_s: 0.001
"""


@pytest.fixture
def reads(tmp_path):
    def of(text):
        path = tmp_path / "instrument.yaml"
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return read(path)

    return of


def test_the_shortest_file(reads):
    i = reads(SIMPLE)
    assert i.focal_px == 93750
    assert i == Instrument(93750.0)
    assert i.camera_for(100, 80) == Camera.from_focal(100, 80, 93750.0)


def test_every_key(reads):
    i = reads(FULL)
    assert i.camera == Camera(1392, 1040, 5200.5, 5201.5, 700.25, 520.0, (-0.1, 0.01, 1e-3, -2e-3, 0.0))
    assert i.focal_px == 5200.5
    assert i.calibration.misalignment_deg == (0.1, -0.2, 30.0)
    assert i.inclinometer.noise_rad == pytest.approx(np.radians(0.002))
    assert i.clock_stddev_s == 0.001
    np.testing.assert_allclose(
        np.sqrt(np.diag(i.mounting.calibration_covariance)), np.radians([1 / 3600, 2 / 3600, 3 / 3600])
    )
    np.testing.assert_array_equal(i.mounting.link_to_camera, [[0, 1, 0], [-1, 0, 0], [0, 0, 1]])


def test_misalignment_is_r3_r2_r1():
    """DESIGN section 3: A3 = R3(rz) R2(ry) R1(rx), active, C into S."""
    np.testing.assert_allclose(Calibration((90, 0, 0)).a3 @ [0, 1, 0], [0, 0, 1], atol=1e-15)
    np.testing.assert_allclose(Calibration((0, 90, 0)).a3 @ [0, 0, 1], [1, 0, 0], atol=1e-15)
    np.testing.assert_allclose(Calibration((0, 0, 90)).a3 @ [1, 0, 0], [0, 1, 0], atol=1e-15)
    # R1 acts first: y -> z -> (R2) x -> (R3) y
    np.testing.assert_allclose(Calibration((90, 90, 90)).a3 @ [0, 1, 0], [0, 1, 0], atol=1e-15)


def test_the_link_looks_along_the_top_of_the_frame():
    link = Instrument(1.0).mounting.link_to_camera
    np.testing.assert_array_equal(link @ [1, 0, 0], [0, -1, 0])
    np.testing.assert_array_equal(link @ [0, 0, 1], [0, 0, 1])
    assert np.linalg.det(link) == pytest.approx(1)


def test_intrinsics_of_another_frame_size(reads):
    with pytest.raises(InstrumentError, match="1392 x 1040"):
        reads(FULL).camera_for(1392, 1041)


def test_the_camera_of_a_calibration_file_beside_it_or_elsewhere(reads, tmp_path):
    camera = Camera(1392, 1040, 5200.5, 5201.5, 700.25, 520.0, (-0.1, 0.01, 1e-3, -2e-3, 0.0))
    camera_yaml.write(tmp_path / "optics" / "camera.yaml", camera, "camera")
    for name in ("optics/camera.yaml", tmp_path / "optics" / "camera.yaml"):
        i = reads(f"starpos_instrument: 1\ncamera: {{calibration: {name}}}\n")
        assert (i.camera, i.focal_px) == (camera, 5200.5)


REFUSED = {
    "empty": ("", "first key"),
    "no mapping": ("- 1\n- 2\n", "first key"),
    "no format": ("camera: {focal_mm: 600, pixel_um: 6.4}\n", "first key"),
    "another format": (SIMPLE.replace(": 1", ": 2", 1), "first key"),
    "no camera": ("starpos_instrument: 1\n", "camera"),
    "camera of nothing": ("starpos_instrument: 1\ncamera:\n", "camera is missing: give {focal_mm"),
    "half a camera": ("starpos_instrument: 1\ncamera: {focal_mm: 600}\n", "pixel_um"),
    "unknown key": (SIMPLE + "misaligment_deg: [0, 0, 0]\n", "unknown key 'misaligment_deg'"),
    "unknown camera key": (SIMPLE.replace("}", ", distorsion: [0, 0, 0, 0, 0]}"), "distorsion"),
    "two cameras": (FULL.replace("width", "focal_mm: 600, pixel_um: 6.4, width"), "unknown key 'width'"),
    "no calibration": ("starpos_instrument: 1\ncamera: {calibration: none.yaml}\n", "none.yaml: not a readable calib"),
    "a calibration of nothing": ("starpos_instrument: 1\ncamera: {calibration: }\n", "calibration is missing: give"),
    "a calibration and more": ("starpos_instrument: 1\ncamera: {calibration: a, width: 5}\n", "unknown key 'width'"),
    "itself for a calibration": ("starpos_instrument: 1\ncamera: {calibration: instrument.yaml}\n", "image_width"),
    "nan": (SIMPLE + "misalignment_deg: [.nan, 0, 0]\n", "finite"),
    "infinite size": (FULL.replace("1392", ".inf"), "width"),
    "fraction of a pixel": (FULL.replace("1392", "1392.5"), "width"),
    "infinite noise": (SIMPLE + "tilt_noise_deg: .inf\n", "finite"),
    "negative noise": (SIMPLE + "clock_stddev_s: -1\n", "negative"),
    "two angles": (SIMPLE + "misalignment_deg: [0, 0]\n", "three numbers"),
    "text for angles": (SIMPLE + "misalignment_deg: '123'\n", "list of numbers"),
    "one angle": (SIMPLE + "misalignment_deg: 5\n", "list of numbers"),
    "no rotation": (SIMPLE + "link_to_camera: [[1, 0, 0], [0, 1, 0], [0, 0, 2]]\n", "rotation"),
    "a mirror": (SIMPLE + "link_to_camera: [[1, 0, 0], [0, 1, 0], [0, 0, -1]]\n", "rotation"),
    "a ragged matrix": (SIMPLE + "link_to_camera: [[1, 0, 0], [0, 1], [0, 0, 1]]\n", ""),
    "zero focal length": (SIMPLE.replace("600", "0"), "positive"),
    "words": (SIMPLE.replace("600", "long"), "focal_mm is 'long': give a number"),
    "a number for a camera": ("starpos_instrument: 1\ncamera: 5\n", "camera is 5: give {focal_mm"),
    "a frame of terapixels": (FULL.replace("1392", "1" + "0" * 12), "width"),
    "a number beyond floats": (SIMPLE.replace("600", "0x" + "f" * 5000), "focal_mm is a number beyond"),
    "no noise at all": (SIMPLE + "tilt_noise_deg: 0\n", "tilt_noise_deg) is 0 deg: must be positive"),
    "a list for the noise": (SIMPLE + "tilt_noise_deg: [1]\n", "tilt_noise_deg is [1]: give a number"),
    "one error": (SIMPLE + "calibration_stddev_arcsec: 5\n", "calibration_stddev_arcsec is 5: give a list of numbers"),
    "an error that is a word": (SIMPLE + "calibration_stddev_arcsec: [1, x, 1]\n", "calibration_stddev_arcsec is 'x'"),
    "a matrix of nothing": (SIMPLE + "link_to_camera:\n", "link_to_camera is missing"),
    "no distortion": (FULL.replace("[-0.1, 0.01, 1e-3, -2e-3, 0]", "none"), "distortion is 'none'"),
    "a tag that lies": (SIMPLE + "clock_stddev_s: !!timestamp abc\n", "not a readable instrument file (it is no YAML)"),
    "users of a machine": ("root:x:0:0:root:/root:/bin/bash\nbin:x:1:1\n", "first key"),
    "an equals sign": ("a: [=]\n", "not a readable instrument file (it is no YAML, line 1)"),
    "a value that starts with an equals sign": ("root: =\n", "instrument file"),
    "laughs": ("a: &a [x, x]\n" + "".join(f"{b}: &{b} [{', '.join(f'*{a}' for _ in range(9))}]\n"
               for a, b in pairwise("abcdefghijkl")) + "starpos_instrument: 1\ncamera: *l\n", "unknown key"),
    "a camera of laughs": ("starpos_instrument: 1\ncamera:\n" + "".join(
        ["  - &a [x, x]\n"] + [f"  - &{b} [{', '.join(f'*{a}' for _ in range(9))}]\n"
                               for a, b in pairwise("abcdefghijkl")]), "camera is [["),
    "broken yaml": ("starpos_instrument: 1\ncamera: {focal_mm: [\n", "not a readable"),
    "an empty file of tags": ("!!binary 5\n", "instrument file"),
    "tabs": ("starpos_instrument: 1\n\tcamera: 1\n", "not a readable"),
    "binary": (bytes(range(256)), "not a readable"),
    "two documents": (SIMPLE + "---\n" + SIMPLE, "not a readable"),
    "huge": (SIMPLE + "#" * (1 << 20), "over 1 MiB"),
    "deep": ("starpos_instrument: 1\ncamera: " + "[" * 5000, "not a readable"),
    "five terms": (FULL.replace(", 0]}", "]}"), "plumb_bob"),
    "a date that is none": (SIMPLE + "clock_stddev_s: 2026-99-99\n", "not a readable"),
    "python object": (SIMPLE + "tilt_noise_deg: !!python/object/apply:os.system ['touch EXECUTED']\n", "not a readable"),
    "python tuple": (SIMPLE + "misalignment_deg: !!python/tuple [0, 0, 0]\n", "not a readable"),
}  # fmt: skip


@pytest.mark.parametrize("kind", REFUSED)
def test_refused_with_one_sentence_that_names_the_file(kind, reads, tmp_path):
    text, words = REFUSED[kind]
    with pytest.raises(InstrumentError) as e:
        reads(text.replace("EXECUTED", str(tmp_path / "executed")) if isinstance(text, str) else text)
    assert words in str(e.value)
    assert "instrument.yaml" in str(e.value)
    assert "\n" not in str(e.value)
    assert not (tmp_path / "executed").exists()


def test_a_file_that_is_not_there_and_a_folder(tmp_path):
    for path in (tmp_path / "none.yaml", tmp_path):
        with pytest.raises(InstrumentError, match="not a readable instrument file"):
            read(path)


def test_focal_length_in_pixels():
    assert focal_px_of(600.0, 6.4) == 93750.0
    for focal, pixel in (
        (0.0, 6.4),
        (600.0, 0.0),
        (-600.0, -6.4),
        (float("nan"), 6.4),
        (600.0, float("inf")),
    ):
        with pytest.raises(InstrumentError, match="both must be positive"):
            focal_px_of(focal, pixel)

# SPDX-License-Identifier: Apache-2.0
import pickle

import cv2
import numpy as np
import pytest

from starpos.errors import InstrumentError
from starpos.instrument import instrument_file
from starpos.instrument.camera import Camera, check_axis
from starpos.instrument.instrument_file import read_camera, write_camera

SIZE = (5616, 3744)
# A wide lens.
STRONG = (-0.28, 0.11, 1.2e-3, -8e-4, -0.02)
WIDE = Camera(width=1392, height=1040, fx=1300.0, fy=1305.0, cx=700.3, cy=515.8, distortion=STRONG)
PAPER = Camera.from_focal(*SIZE, 93750.0)
BENT = Camera(
    width=SIZE[0], height=SIZE[1], fx=93750.0, fy=93800.0, cx=2800, cy=1870, distortion=(0.3, 5.0, 1e-3, 2e-3, 0)
)  # fmt: skip

# of an Azure Kinect, and of an OAK-D, whose polynomials all but cancel
KINECT = Camera(
    width=1280, height=960, fx=610.0, fy=609.8, cx=638.4, cy=481.2, model="rational_polynomial",
    distortion=(0.513, -2.733, 4.5e-4, -2.1e-4, 1.618, 0.392, -2.558, 1.544),
)  # fmt: skip
OAK = Camera(
    width=1280, height=800, fx=796.0, fy=796.5, cx=641.0, cy=398.0, model="rational_polynomial",
    distortion=(-5.33, 16.2, 5e-4, -9e-4, -8.05, -5.37, 16.37, -8.41),
)  # fmt: skip


def pixels(camera, rng, n=500):
    return rng.uniform(0, camera.width - 1, n), rng.uniform(0, camera.height - 1, n)


@pytest.mark.parametrize("camera", [WIDE, PAPER, BENT, KINECT, OAK])
def test_projection_is_opencvs(camera, rng):
    """cv2.projectPoints has the same pinhole, the same plumb_bob and the same pixel (0, 0)."""
    v = camera.directions(*pixels(camera, rng))
    matrix = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    zero = np.zeros(3)
    theirs = cv2.projectPoints(v.reshape(-1, 1, 3), zero, zero, matrix, np.array(camera.distortion))[0][:, 0]
    np.testing.assert_allclose(camera.project(v), theirs, atol=1e-9)


@pytest.mark.parametrize("camera", [WIDE, PAPER, KINECT, OAK])
def test_round_trip(camera, rng):
    x, y = pixels(camera, rng)
    v = camera.directions(x, y)
    np.testing.assert_allclose(np.linalg.norm(v, axis=1), 1, atol=1e-15)
    np.testing.assert_allclose(camera.project(v), np.stack([x, y], 1), atol=1e-9)


def test_axes():
    """W = (X, Y, f) / norm: X along columns, Y along rows, z along the optical axis."""
    cx, cy = PAPER.centre_px
    assert (cx, cy) == (2807.5, 1871.5)
    v = PAPER.directions([cx, cx + 93750, cx], [cy, cy, cy + 93750])
    np.testing.assert_allclose(v, [[0, 0, 1], [0.5**0.5, 0, 0.5**0.5], [0, 0.5**0.5, 0.5**0.5]], atol=1e-15)


def test_paper_scale_and_field():
    """2.2 arcsec a pixel, not milliarcsec as the paper prints; 3.43 by 2.29 deg, a diagonal of 4.13."""
    assert 3600 * np.degrees(6.4e-6 / 0.6) == pytest.approx(PAPER.scale_arcsec)
    assert PAPER.scale_arcsec == pytest.approx(2.2, abs=0.01)
    assert 2 * np.degrees(PAPER.half_diagonal_rad) == pytest.approx(4.13, abs=0.01)


def test_nothing_is_seen_behind_the_camera():
    assert np.isnan(PAPER.project([[0, 0, -1.0], [1, 0, 0]])).all()


def test_scaled_keeps_all_but_the_focal_lengths():
    twice = WIDE.scaled(2.0)
    assert (twice.fx, twice.fy, twice.cx, twice.distortion) == (2600.0, 2610.0, WIDE.cx, WIDE.distortion)


def test_no_stars_are_no_error():
    assert WIDE.directions([], []).shape == (0, 3)
    assert WIDE.project(np.zeros((0, 3))).shape == (0, 2)


def test_a_distortion_that_folds_the_frame_is_refused():
    folded = Camera(
        width=1000, height=1000, fx=500.0, fy=500.0, cx=499.5, cy=499.5, distortion=(-0.6, 0.0, 0.0, 0.0, 0.0)
    )
    with pytest.raises(InstrumentError, match="cannot be inverted"):
        folded.directions([0.0, 500.0], [0.0, 500.0])


@pytest.mark.parametrize(
    ("change", "words"),
    [({"fx": 0.0}, "positive"), ({"fy": -1.0}, "positive"), ({"cx": float("nan")}, "not finite"),
     ({"distortion": (0.0, 0.0, float("inf"), 0.0, 0.0)}, "not finite"), ({"width": 0}, "at least 1"),
     ({"distortion": (0.1, 0.2)}, "plumb_bob has 5")],
)  # fmt: skip
def test_impossible_intrinsics_are_refused(change, words):
    good = {"width": 100, "height": 80, "fx": 900.0, "fy": 900.0, "cx": 49.5, "cy": 39.5}
    with pytest.raises(InstrumentError, match=words):
        Camera(**good | change)


def test_a_camera_whose_lens_is_made_goes_to_other_processes(rng):
    v = WIDE.directions(*pixels(WIDE, rng, 5))
    for camera in (WIDE, KINECT):
        again = pickle.loads(pickle.dumps(camera))
        assert again == camera
        np.testing.assert_array_equal(again.project(v), camera.project(v))


@pytest.mark.parametrize("camera", [WIDE, PAPER, KINECT])
def test_a_pixel_that_is_no_number_has_no_direction(camera):
    v = camera.directions([np.nan, 100.0], [50.0, 60.0])
    assert np.isnan(v[0]).any() and np.isfinite(v[1]).all()


@pytest.mark.parametrize(("cx", "cy"), [(319.5, 239.5), (-400.0, 767.5), (1023.5, 1600.0), (1900.0, 1400.0)])
def test_an_axis_at_the_corner_of_the_whole_frame_is_refused(tmp_path, cx, cy):
    with pytest.raises(InstrumentError, match="optical axis is at pixel"):
        check_axis(2048, 1536, cx, cy, "camera_info")
    camera = f"{{width: 2048, height: 1536, fx: 900, fy: 900, cx: {cx}, cy: {cy}}}"
    (tmp_path / "instrument.yaml").write_text(f"starpos_instrument: 1\ncamera: {camera}\n")
    write_camera(
        tmp_path / "camera.yaml", Camera(width=2048, height=1536, fx=900.0, fy=900.0, cx=cx, cy=cy), "any"
    )
    for read, name in ((instrument_file.read, "instrument.yaml"), (read_camera, "camera.yaml")):
        with pytest.raises(InstrumentError, match="optical axis is at pixel"):
            read(tmp_path / name)


@pytest.mark.parametrize(
    ("width", "height", "cx", "cy"),
    # the last two: a shifted lens, and a message without a size
    [
        (2048, 1536, 1023.5, 767.5),
        (2048, 1536, 1100.0, 600.0),
        (2048, 1536, 1023.5, 200.0),
        (0, 0, 10.0, 10.0),
    ],
)
def test_an_axis_in_the_frame_is_believed(width, height, cx, cy):
    check_axis(width, height, cx, cy, "camera_info")

# SPDX-License-Identifier: Apache-2.0
"""CameraInfo as other people's drivers and calibrations send it: as OpenCV means it, to 0.01 px."""

import cv2
import numpy as np
import pytest
from sensor_msgs.msg import CameraInfo, RegionOfInterest

from starpos.errors import InstrumentError
from starpos.instrument.camera import Camera
from starpos.messages.camera import message_to_camera
from starpos_common.messages import camera_to_message

K = np.array([[1010.0, 0, 633.2], [0, 1012.0, 470.9], [0, 0, 1]])
PLUMB, RATIONAL = "plumb_bob", "rational_polynomial"
FOUR = [-0.28, 0.07, 2e-4, -3e-4]
EIGHT = [0.513, -2.733, 4.5e-4, -2.1e-4, 1.618, 0.392, -2.558, 1.544]


def info(model=PLUMB, d=(), **fields):
    about = {"width": 1280, "height": 960, "distortion_model": model, **fields}
    return CameraInfo(d=[float(v) for v in d], k=K.ravel().tolist(), **about)


@pytest.mark.parametrize(
    ("model", "d", "reduced"),
    [
        (PLUMB, FOUR, PLUMB),
        (PLUMB, [*FOUR, -0.02], PLUMB),
        (PLUMB, EIGHT, RATIONAL),
        (RATIONAL, EIGHT, RATIONAL),
        (RATIONAL, [*FOUR, -0.02, 0, 0, 0], PLUMB),
        (RATIONAL, [*EIGHT, 0, 0, 0, 0], RATIONAL),
        (RATIONAL, [*EIGHT, 0, 0, 0, 0, 0, 0], RATIONAL),
        (RATIONAL, [*FOUR, -0.02], PLUMB),
        ("", FOUR, PLUMB),
        (PLUMB, [], PLUMB),
    ],
)
def test_distortions_of_any_number_of_terms_are_opencvs(model, d, reduced):
    camera = message_to_camera(info(model, d))
    assert camera.model == reduced
    x, y = (np.random.default_rng(2).uniform(0, side - 1, 400) for side in (1280, 960))
    v = camera.directions(x, y)
    theirs = cv2.projectPoints(v[:, None], np.zeros(3), np.zeros(3), K, np.array(d, float) if d else None)[0][
        :, 0
    ]
    np.testing.assert_allclose(theirs, np.stack([x, y], 1), atol=0.01)
    np.testing.assert_allclose(camera.project(v), theirs, atol=0.01)
    # what a node sends again is the same camera
    assert message_to_camera(camera_to_message(camera, "c")) == camera


@pytest.mark.parametrize(
    ("model", "d"),
    [
        (RATIONAL, [*EIGHT, 1e-3, 0, 0, 0]),
        (PLUMB, [0.1] * 6),
        (PLUMB, [0.1]),
        ("equidistant", [0.1] * 8),
        ("omni", FOUR),
    ],
)
def test_what_is_beyond_these_is_refused_with_what_is_understood(model, d):
    with pytest.raises(InstrumentError, match=f"{model!r} with {len(d)} terms.*4, 5 or 8"):
        message_to_camera(info(model, d))


@pytest.mark.parametrize("binning", [1, 2, 4])
@pytest.mark.parametrize(
    ("left", "top", "width", "height"), [(0, 0, 0, 0), (0, 0, 1280, 960), (160, 80, 640, 480)]
)
def test_region_and_binning_move_the_pixels(binning, left, top, width, height):
    """A pixel of the image covers binning x binning ones of the sensor, from the region's corner on."""
    roi = RegionOfInterest(x_offset=left, y_offset=top, width=width, height=height)
    whole = message_to_camera(info(PLUMB, FOUR))
    camera = message_to_camera(info(PLUMB, FOUR, roi=roi, binning_x=binning, binning_y=binning))
    assert (camera.width, camera.height) == ((width or 1280) // binning, (height or 960) // binning)
    x, y = np.arange(5.0, 150.0, 29.0), np.arange(3.0, 110.0, 22.0)
    of_the_sensor = [start + n * binning + (binning - 1) / 2 for start, n in ((left, x), (top, y))]
    np.testing.assert_allclose(camera.directions(x, y), whole.directions(*of_the_sensor), atol=1e-12)


def test_binning_of_one_direction_only():
    camera = message_to_camera(info(binning_x=2))
    assert (camera.width, camera.height, camera.fx, camera.fy) == (640, 960, 505.0, 1012.0)


def test_a_region_beyond_the_sensor_is_refused():
    with pytest.raises(InstrumentError, match="ends at pixel 1300 of 1280"):
        message_to_camera(info(roi=RegionOfInterest(x_offset=660, width=640, height=480)))


def test_a_size_that_is_left_open_is_that_of_the_images():
    message = info(PLUMB, FOUR)
    message.width = message.height = 0
    with pytest.raises(InstrumentError, match="size 0 x 0"):
        message_to_camera(message)
    camera = message_to_camera(message, size=(640, 480))
    assert (camera.width, camera.height, camera.cx) == (640, 480, K[0, 2])
    # a stated one stands
    assert message_to_camera(info(), size=(640, 480)).width == 1280
    message.roi = RegionOfInterest(x_offset=100, width=320, height=240)
    assert message_to_camera(message, size=(640, 480)).width == 320


def test_zero_k_is_refused():
    for size in (None, (640, 480)):
        with pytest.raises(InstrumentError, match="not calibrated"):
            message_to_camera(CameraInfo(width=1280, height=960), size=size)


def test_an_ideal_camera_stays_one():
    assert message_to_camera(info(RATIONAL, [0.0] * 8)).is_ideal
    assert message_to_camera(info("equidistant", [0.0] * 4)).is_ideal is False
    assert Camera.from_focal(4, 4, 10.0).is_ideal

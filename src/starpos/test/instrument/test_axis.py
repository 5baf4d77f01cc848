# SPDX-License-Identifier: Apache-2.0
"""Parts of a sensor's frame: their cameras, and what is known of their axis."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from starpos.errors import InstrumentError
from starpos.instrument.camera import EQUIDISTANT, Camera
from starpos.instrument.instrument import MIN_UNKNOWN_PX, Calibration, Instrument, with_frame_size

KNOWN = Calibration.of((0.0, 0.0, 0.0), (5.0, 5.0, 5.0))
LENS = Camera(
    width=600, height=400, fx=900.0, fy=905.0, cx=310.0, cy=190.0, distortion=(0.1, 0.0, 0.0, 0.0, 0.0)
)


def frame(width, height, origin_px=None):
    return SimpleNamespace(width=width, height=height, origin_px=origin_px)


@pytest.mark.parametrize(
    "instrument",
    [Instrument(900.0, frame_size=(600, 400)), Instrument(900.0, camera=LENS)],
    ids=["ideal", "a lens"],
)
def test_a_part_of_the_frame_sees_what_the_whole_one_sees_there(instrument):
    whole, part = instrument.camera_for(600, 400), instrument.camera_for(200, 150, (350.0, 20.0))
    x, y = np.array([0.0, 199.0, 80.5]), np.array([0.0, 149.0, 30.25])
    assert part.directions(x, y) == pytest.approx(whole.directions(x + 350, y + 20), abs=1e-12)
    assert (part.width, part.height) == (200, 150)
    assert instrument.whole_of(part, (350.0, 20.0)) == whole
    assert instrument.camera_for(600, 400, (0.0, 0.0)) is whole


@pytest.mark.parametrize(
    ("size", "origin"),
    [((200, 150), None), ((200, 150), (450.0, 20.0)), ((200, 150), (-1.0, 0.0)), ((200, 150), (math.nan, math.nan)),
     ((601, 400), (0.0, 0.0)), ((400, 600), None)],
)  # fmt: skip
def test_a_part_of_unknown_place_or_beyond_the_whole_is_refused(size, origin):
    with pytest.raises(InstrumentError, match=r"A3 are of 600 x 400 px.*XORGSUBF"):
        Instrument(900.0, frame_size=(600, 400)).camera_for(*size, origin)


@pytest.mark.parametrize(
    "size", [(600, 400), (400, 600), (1640, 1232), (1936, 1216), (3008, 3008), (4144, 2822)]
)
def test_the_first_frame_of_a_night_counts_as_a_whole_one_where_a_sensor_has_its_shape(size):
    instrument, said = with_frame_size(Instrument(900.0, calibration=KNOWN), frame(*size))
    assert (instrument.size, said) == (size, "") and instrument.calibration == KNOWN
    with pytest.raises(InstrumentError):
        instrument.camera_for(300, 200)


@pytest.mark.parametrize(
    ("first", "size", "words"),
    [
        (frame(600, 260), (600, 260), "no sensor has the shape of frames of 600 x 260 px"),
        (
            frame(600, 400, (0.0, 0.0)),
            (600, 400),
            "begin at column 0, row 0 of a sensor whose size is not stated",
        ),
        (frame(600, 400, (100.0, 50.0)), (800, 500), "begin at column 100, row 50"),
        (frame(600, 400, (math.nan, math.nan)), None, "cut out of larger ones"),
    ],
)
def test_an_axis_of_which_nobody_says_where_it_is_is_an_error_of_a3_and_told(first, size, words):
    instrument, said = with_frame_size(Instrument(90000.0, calibration=KNOWN), first)
    assert instrument.size == size and words in said and "width, height" in said
    sigma = np.sqrt(np.diag(instrument.calibration.covariance_arcsec2))
    assert sigma == pytest.approx(np.full(3, np.degrees(MIN_UNKNOWN_PX / 90000) * 3600), rel=1e-3)
    # parts of one sensor lie as their headers say, wherever its axis is
    if size is not None and first.origin_px is not None:
        one, other = (instrument.camera_for(300, 200, (x, 40.0)) for x in (50.0, 90.0))
        assert one.cx - other.cx == 40


@pytest.mark.parametrize("size", [(1600, 1200), (480, 640)])
def test_a_size_that_is_of_whole_frames_and_of_parts_is_told_and_widens_nothing(size):
    instrument, said = with_frame_size(Instrument(900.0, calibration=KNOWN), frame(*size))
    assert (instrument.size, instrument.calibration) == (size, KNOWN)
    assert f"frames of {size[0]} x {size[1]} px count as whole ones" in said and "width, height" in said
    stated = Instrument(900.0, calibration=KNOWN, frame_size=size)
    assert [with_frame_size(i, frame(*size))[1] for i in (stated, Instrument(900.0))] == ["", ""]


def test_a_fisheye_that_is_cut_out_shows_its_axis_and_has_its_own_camera():
    cut = frame(2832, 2832, (math.nan, math.nan))
    instrument, _ = with_frame_size(Instrument(970.0, model=EQUIDISTANT), cut)
    assert math.radians(1.5) < instrument.axis_stddev_rad < math.radians(3)
    # a camera of just this size was calibrated with pictures that are cut out alike
    camera = Camera.from_focal(2832, 2832, 970.0, EQUIDISTANT)
    calibrated = Instrument(970.0, camera=camera)
    assert calibrated.camera_for(2832, 2832, cut.origin_px) is camera
    assert calibrated.whole_of(camera, cut.origin_px) is camera


def test_nothing_is_said_where_the_size_is_known_or_a3_is_not():
    known = Instrument(900.0, calibration=KNOWN, frame_size=(600, 400))
    assert with_frame_size(known, frame(200, 80, (0.0, 0.0))) == (known, "")
    lens = replace(known, frame_size=None, camera=LENS)
    assert with_frame_size(lens, frame(200, 80, (0.0, 0.0))) == (lens, "")
    assert with_frame_size(Instrument(900.0), frame(600, 260))[1] == ""

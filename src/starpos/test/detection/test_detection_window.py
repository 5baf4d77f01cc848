# SPDX-License-Identifier: Apache-2.0
"""Frames of which whole sides are white: the window between them is said."""

from dataclasses import replace

import numpy as np
import pytest

from starpos.detection import detect
from starpos.errors import FrameError
from starpos.frames.frame import Frame
from starpos_testing.skies.rendered import field, grid, noisy

SIZE = (400, 600)
WHITE = np.iinfo(np.uint16).max


@pytest.fixture
def plane(rng):
    return noisy(field(SIZE, grid(SIZE, 30, 12000, rng), sky=60), rng)


def window_of(plane):
    return detect(Frame(plane)).stars.window


@pytest.mark.parametrize(
    ("white", "window"),
    [
        (np.s_[:, 300:], (0, 0, 300, 400)),
        (np.s_[:, :41], (41, 0, 600, 400)),
        (np.s_[350:], (0, 0, 600, 350)),
        (np.s_[:7], (0, 7, 600, 400)),
    ],
)
def test_a_white_side_is_not_in_the_window(white, window, plane):
    plane[white] = WHITE
    assert window_of(plane) == window


def test_white_sides_at_a_corner_are_left_out_both(plane):
    plane[:, 500:] = WHITE
    plane[360:] = WHITE
    assert window_of(plane) == (0, 0, 500, 360)


def test_a_dark_frame_has_no_window(plane):
    assert window_of(plane) is None


def test_a_sky_cut_off_at_zero_is_not_white(plane):
    sky = int(np.median(plane)) + 200
    assert window_of(np.where(plane > sky, plane - sky, 0).astype(np.uint16)) is None


def test_a_lamp_inside_the_frame_is_no_side(plane):
    plane[100:300, 200:400] = WHITE
    assert window_of(plane) is None


@pytest.mark.parametrize("window", [(0, 0, 601, 400), (-1, 0, 10, 10), (300, 0, 300, 400), (0, 20, 600, 10)])
def test_a_window_beyond_the_frame_is_refused(window, plane):
    stars = detect(Frame(plane)).stars
    with pytest.raises(FrameError, match="window"):
        replace(stars, window=window)

# SPDX-License-Identifier: Apache-2.0
"""Negatives, as plates are scanned, show the stars of the frame that they were made of."""

from dataclasses import replace

import numpy as np
import pytest

from starpos.detection import detect
from starpos.detection.second_look import detect_dark_too, negative_of
from starpos.fix.searching import look_at
from starpos.frames.frame import Frame
from starpos.night.reading import stars_of
from starpos_testing.skies.rendered import field, grid, noisy

SIZE = (400, 600)


@pytest.fixture
def frame(rng):
    return Frame(noisy(field(SIZE, grid(SIZE, 30, 12000, rng), sky=60), rng))


def test_dark_stars_on_a_bright_sky_are_those_of_the_frame(frame):
    found, told = detect_dark_too(negative_of(frame)).stars, detect(frame).stars
    assert found.negative and not told.negative
    assert len(found) == len(told) >= 25
    assert (found.x, found.y, found.flux) == tuple(map(pytest.approx, (told.x, told.y, told.flux)))


def test_colours_are_exchanged_too(frame):
    grey = (frame.pixels >> 4).clip(0, 255).astype(np.uint8)
    colours = Frame(np.repeat(grey[..., None], 3, axis=2))
    assert detect_dark_too(negative_of(colours)).stars.negative


def test_a_frame_with_stars_or_without_any_is_no_negative(frame, rng):
    assert not detect_dark_too(frame).stars.negative
    empty = Frame(noisy(field(SIZE, grid(SIZE, 30, 1, rng), sky=60), rng))
    assert not detect_dark_too(empty).stars.negative
    # dust on a cloudy sky: a few dark spots are no stars
    dusty = empty.pixels.copy()
    dusty[100:103, 200:203] = dusty[300:304, 50:54] = 0
    assert not detect_dark_too(Frame(dusty)).stars.negative


def test_a_night_looks_at_the_negative_again(frame):
    dark = negative_of(frame)
    stars = stars_of(dark)
    assert stars.negative
    place = stars.x[:3], stars.y[:3]
    again = look_at(dark, stars)(*place), look_at(frame, replace(stars, negative=False))(*place)
    assert again[0][1] == pytest.approx(again[1][1], rel=0.05) and (again[0][1] > 10).all()

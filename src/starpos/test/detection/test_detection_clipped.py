# SPDX-License-Identifier: Apache-2.0
"""Stars clipped to a few flat pixels, as a stretched picture has them: they are found, and come first."""

import cv2
import numpy as np
import pytest

from starpos.detection import detect
from starpos.frames.frame import Frame
from starpos_testing.skies.rendered import field, grid, match, noisy

SIZE = (480, 640)
SKY, NOISE, WHITE = 40.0, 12.0, 255.0


def light_of(n):
    """Light of stars, DN: every sixth is clipped, from a little to a thousandfold; no other is."""
    step = np.arange(n)
    return np.where(step % 6, 900.0, 5e3 * 1.3 ** (step // 6))


@pytest.fixture
def stretched(rng):
    """A picture of sharp stars whose contrast was raised till a sixth of them are white, and the stars (N, 3)."""
    stars = grid(SIZE, 40, light_of, rng)
    light = field(SIZE, stars, fwhm=2.2, sky=SKY) + rng.normal(0, NOISE, SIZE)
    return np.clip(np.rint(light), 0, WHITE).astype(np.uint8), stars


def check(found, stars, within_px):
    """Clipped stars are found in their places, and come first."""
    bright = stars[stars[:, 2] > 5e4]
    rank = match(found, bright, within_px)
    assert rank.min() >= 0
    assert rank.max() < np.count_nonzero(stars[:, 2] > 1e3)
    assert (match(found, stars) >= 0).mean() > 0.9
    assert len(found) < 1.1 * len(stars)


def test_stars_clipped_to_few_pixels_are_found_and_come_first(stretched):
    pixels, stars = stretched
    check(detect(Frame(pixels)).stars, stars, 0.5)


def test_so_are_those_of_a_colour_picture_whose_compression_blurred_the_limit(stretched, rng):
    pixels, stars = stretched
    colours = np.clip(pixels[..., None] * np.array([0.9, 1.0, 1.0]) + rng.normal(0, 4, (*SIZE, 3)), 0, WHITE)
    packed = cv2.imencode(".jpg", np.rint(colours).astype(np.uint8), [cv2.IMWRITE_JPEG_QUALITY, 60])[1]
    check(detect(Frame(cv2.imdecode(packed, cv2.IMREAD_COLOR))).stars, stars, 1.0)


def test_a_saturated_star_with_wings_keeps_the_place_that_they_tell(rng):
    stars = grid(SIZE, 60, lambda n: np.where(np.arange(n) % 4, 3000.0, 60000.0), rng)
    found = detect(Frame(noisy(field(SIZE, stars), rng, top=4095))).stars
    bright = stars[stars[:, 2] > 1e4]
    index = match(found, bright)
    assert index.min() >= 0
    error = np.stack([found.x, found.y], 1)[index] - bright[:, :2]
    assert np.sqrt(np.mean(error**2)) < 0.03
    assert np.allclose(found.flux[index] / np.median(found.flux[index]), 1, atol=0.1)

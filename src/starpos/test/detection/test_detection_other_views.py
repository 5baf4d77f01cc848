# SPDX-License-Identifier: Apache-2.0
"""Stars that the first way to see a frame misses: sharp ones before a nebula, and wide ones under noise with peaks."""

import cv2
import numpy as np
import pytest

from starpos.detection import detect
from starpos.detection.second_look import VIEWS, other_views
from starpos.frames.frame import Frame
from starpos_testing.skies.rendered import field, grid

SIZE = (400, 600)


def nearest(stars, x, y):
    """Distance (N,) px of each place from the star found nearest to it; inf without stars."""
    if not len(stars):
        return np.full(len(x), np.inf)
    return np.hypot(x[:, None] - stars.x, y[:, None] - stars.y).min(1)


def nebula(rng):
    """Light of all sizes above a star's, as a nebula or a lit cloud has it."""
    light = np.zeros(SIZE)
    for sigma, height in ((8, 20), (15, 40), (30, 50)):
        noise = cv2.GaussianBlur(rng.normal(size=SIZE), (0, 0), sigma)
        light += height * np.maximum(noise / noise.std(), 0)
    return light


def test_sharp_stars_before_a_nebula(rng):
    stars = grid(SIZE, 40, 200, rng)
    x, y = stars[:, :2].T
    light = field(SIZE, stars, fwhm=1.3, sky=10) + nebula(rng) + rng.normal(0, 1.5, SIZE)
    frame = Frame(light.clip(0, 255).round().astype(np.uint8))
    first, flat = detect(frame).stars, next(other_views(frame, None))
    assert np.mean(nearest(first, x, y) < 1) < 0.5
    assert np.mean(nearest(flat, x, y) < 1) > 0.8
    assert (flat.width, flat.height) == SIZE[::-1]


def test_wide_stars_under_noise_with_sharp_peaks(rng):
    """Discs of 24 px, as of a telephone out of focus, in noise that its program has smoothed into specks."""
    size = 1200, 1600
    (x, y), specks = rng.uniform(60, 1140, (2, 12)), rng.uniform(60, 1140, (15, 2))
    sky = cv2.GaussianBlur(rng.normal(size=size).astype(np.float32), (0, 0), 2.0)
    pixels = 14 * sky / sky.std() + field(size, np.insert(specks, 2, 1000, axis=1), fwhm=4.0, sky=100)
    disc = np.hypot(*np.mgrid[-12:13, -12:13]) < 12
    for cx, cy in zip(np.rint(x).astype(int), np.rint(y).astype(int), strict=True):
        pixels[cy - 12 : cy + 13, cx - 12 : cx + 13] += 60 * disc
    frame = Frame(pixels.clip(0, 255).astype(np.uint8))
    assert np.mean(nearest(detect(frame).stars, x, y) < 3) < 0.5
    *_, reduced = other_views(frame, (0, 0, 1600, 1000))
    assert np.mean(nearest(reduced, x, y) < 3) > 0.8
    assert reduced.window == (0, 0, 1600, 1000)


@pytest.mark.parametrize("size", [(1, 1), (70, 90), (2, 500)])
def test_small_and_empty_frames_are_seen_in_the_ways_that_fit(size):
    seen = list(other_views(Frame(np.full(size, 7, np.uint8)), None))
    assert len(seen) <= len(VIEWS) and not any(map(len, seen))

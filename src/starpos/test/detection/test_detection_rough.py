# SPDX-License-Identifier: Apache-2.0
"""Frames as people take them: binned, half white, badly compressed, defocused, with a roof. Their stars are found."""

import cv2
import numpy as np
import pytest

from starpos.detection import detect
from starpos.detection.learn import _typical_shape
from starpos.frames.frame import Frame
from starpos_testing.skies.rendered import field, grid, noisy

SIZE = (400, 600)


def share_found(found, stars, within_px=1.5):
    """Share of the true stars that have a detection at their place, and of the detections that have a true star."""
    apart = np.hypot(found.x[:, None] - stars[:, 0], found.y[:, None] - stars[:, 1])
    if not len(found):
        return 0.0, 0.0
    return np.mean(apart.min(0) < within_px), np.mean(apart.min(1) < within_px)


def test_moments_with_two_negative_widths_are_no_star():
    """Dark surroundings make both widths negative, and the determinant positive."""
    y, x = np.mgrid[-12:13, -12:13]
    star = 400 * np.exp(-0.5 * (x * x + y * y) / 0.9)
    signal = np.stack([star, star, *[star - 6.0] * 5]).astype(np.float32)
    shape, _ = _typical_shape(signal, 0.0, True)
    assert np.sqrt(np.trace(shape[0]) / 2) < 1.3


@pytest.mark.parametrize("fwhm_px", [1.0, 1.3])
def test_stars_sharper_than_a_pixel_are_found_where_few_are_bright(fwhm_px, rng):
    stars = grid(SIZE, 60, lambda n: np.where(np.arange(n) % 12, 700.0, 4000.0), rng)
    found = detect(Frame(noisy(field(SIZE, stars, fwhm_px), rng))).stars
    there, true = share_found(found, stars)
    assert there > 0.9
    assert true > 0.9


def test_a_half_white_frame_gives_the_stars_of_its_other_half(rng):
    stars = grid(SIZE, 50, 6000, rng)
    pixels = noisy(field(SIZE, stars), rng)
    pixels[:, SIZE[1] // 2 :] = np.iinfo(pixels.dtype).max
    found = detect(Frame(pixels)).stars
    there, true = share_found(found, stars[stars[:, 0] < SIZE[1] // 2 - 15])
    assert there > 0.95
    assert true > 0.9


def test_a_roof_raises_no_threshold_beside_it(rng):
    stars = grid(SIZE, 50, 3000, rng)
    y, x = np.indices(SIZE)
    tiles = 300 * (1 + rng.random((80, 120))).repeat(5, 0).repeat(5, 1)
    found = detect(Frame(noisy(np.where(x + 0.3 * y > 420, tiles, field(SIZE, stars)), rng))).stars
    there, _ = share_found(found, stars[stars[:, 0] + 0.3 * stars[:, 1] < 380])
    assert there > 0.9


def test_a_jpeg_of_quality_30_keeps_its_bright_stars_and_adds_few(rng):
    stars = grid(SIZE, 50, lambda n: np.where(np.arange(n) % 3, 300.0, 2500.0), rng)
    light = field(SIZE, stars, sky=40) + rng.normal(0, 4, SIZE)
    picture = np.clip(light, 0, 255).astype(np.uint8)
    squeezed = cv2.imdecode(
        cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 30])[1], cv2.IMREAD_UNCHANGED
    )
    detection = detect(Frame(squeezed))
    bright = stars[:, 2] > 1000
    there, _ = share_found(detection.stars, stars[bright])
    _, true = share_found(detection.stars, stars)
    assert there > 0.95
    assert true > 0.8
    assert detection.fwhm_px < 4


def test_rings_are_found_whose_noise_went_through_the_same_lens_filter(rng):
    """A smoothed or demosaiced frame has correlated noise, which hides that its stars are wide."""
    y, x = np.mgrid[-6:7, -6:7]
    disc = ((x * x + y * y <= 36) & (x * x + y * y >= 4)).astype(float)
    stars = grid(SIZE, 60, 9000, rng)
    frame = noisy(field(SIZE, stars), rng).astype(float)
    blurred = cv2.filter2D(frame, -1, disc / disc.sum(), borderType=cv2.BORDER_REFLECT)
    found = detect(Frame(np.rint(blurred).astype(np.uint16))).stars
    inner = (
        (stars[:, 0] > 20) & (stars[:, 0] < SIZE[1] - 20) & (stars[:, 1] > 20) & (stars[:, 1] < SIZE[0] - 20)
    )
    there, true = share_found(found, stars[inner], 2.0)
    assert there > 0.9
    assert true > 0.9

# SPDX-License-Identifier: Apache-2.0
"""Stars that saturate into discs, and plates on which all images are wide: found, and the brightest come first."""

import numpy as np
import pytest

from starpos.detection import DetectionSettings, detect
from starpos.frames.frame import SATURATED, Frame
from starpos_testing.skies.rendered import grid, match

SIZE = (480, 640)
SKY, TOP = 20.0, 250.0


def plate(stars, fwhm_px, rng, size=SIZE, soft=False, noise=2.0):
    """An 8-bit picture of stars (N, 3), x, y, DN, with wide wings; `soft`: it darkens towards its limit, like a plate."""
    y, x = np.indices(size)
    width2 = (fwhm_px / 1.13) ** 2
    light = np.zeros(size)
    for column, row, flux in stars:
        # beyond, the brightest has less than 0.05 DN
        near = tuple(slice(max(0, int(middle) - 200), int(middle) + 200) for middle in (row, column))
        spread = 1 + ((x[near] - column) ** 2 + (y[near] - row) ** 2) / width2
        light[near] += 1.5 * flux / (np.pi * width2) / (spread**2 * np.sqrt(spread))
    light += rng.normal(0, noise, size)
    if soft:
        light = (TOP - SKY) * (1 - np.exp(-light / (TOP - SKY)))
    return np.clip(np.rint(SKY + light), 0, TOP).astype(np.uint8)


def light_of(brightest):
    """Light of stars, DN: every fifth so bright, each of them a little brighter than the next; others are not clipped."""
    return lambda n: np.where(np.arange(n) % 5, 1500.0, brightest * 0.8 ** (np.arange(n) // 5))


@pytest.mark.parametrize("soft", [False, True])
@pytest.mark.parametrize("brightest", [3e5, 3e6])
def test_stars_clipped_to_discs_are_found_and_rank_by_their_area(brightest, soft, rng):
    stars = grid(SIZE, 80, light_of(brightest), rng)
    found = detect(Frame(plate(stars, 2.5, rng, soft=soft))).stars
    bright = stars[stars[:, 2] > 3e4]
    rank = match(found, bright)
    assert rank.min() >= 0
    assert np.all(found.flags[rank] & SATURATED)
    assert np.sort(rank).tolist() == list(range(len(bright)))
    # neighbours in brightness may change places, as their discs differ by a pixel
    assert np.abs(rank - np.argsort(np.argsort(-bright[:, 2]))).max() <= 2
    assert (match(found, stars) >= 0).mean() > 0.9
    assert len(found) < 1.2 * len(stars)


def test_a_lamp_is_no_disc_and_a_hole_in_a_disc_is(rng):
    stars = grid(SIZE, 100, 1500, rng)
    pixels = plate(stars, 2.5, rng)
    y, x = np.indices(SIZE)
    pixels[np.hypot(x - 50, y - 240) < 40] = TOP
    pixels[np.abs(y - 50) + np.abs(x - 400) / 12 < 4] = TOP
    pixels[np.hypot(x - 350, y - 350) < 9] = TOP
    pixels[np.hypot(x - 350, y - 350) < 3] = SKY
    found = detect(Frame(pixels)).stars
    discs = np.stack([found.x, found.y], 1)[(found.flags & SATURATED) != 0]
    assert np.allclose(discs, [[350, 350]], atol=0.2)


@pytest.mark.parametrize("fwhm_px", [13, 20])
def test_a_plate_whose_images_are_wider_than_the_kernels_is_reduced(fwhm_px, rng):
    size = (900, 1200)
    stars = grid(size, 110, lambda n: 60 * fwhm_px**2 * 1.3 ** (np.arange(n) % 20), rng)
    detection = detect(Frame(plate(stars, fwhm_px, rng, size, soft=True, noise=10)))
    index = match(detection.stars, stars, 0.3 * fwhm_px)
    assert (index >= 0).mean() > 0.9
    assert len(detection.stars) < 1.2 * len(stars)
    assert detection.fwhm_px > 0.8 * fwhm_px
    assert (detection.stars.width, detection.stars.height) == (1200, 900)
    s, faint = detection.stars, (index >= 0) & (stars[:, 2] < np.median(stars[:, 2]))
    error = np.stack([s.x, s.y], 1)[index[faint]] - stars[faint, :2]
    assert np.sqrt(np.mean(error**2)) < 0.1 * fwhm_px
    # the errors that it claims are those that it makes
    assert 0.3 < np.sqrt(np.mean(error**2 / s.sigma[index[faint], None] ** 2)) < 2


def test_a_reduced_frame_knows_the_saturation_that_was_given(rng):
    size = (900, 1200)
    stars = grid(size, 150, 60 * 15**2, rng)
    pixels = plate(stars, 15, rng, size)
    s = detect(Frame(pixels), DetectionSettings(saturation_dn=45)).stars
    assert (s.flags & SATURATED).astype(bool).mean() > 0.8
    assert (detect(Frame(pixels)).stars.flags & SATURATED).astype(bool).mean() < 0.2

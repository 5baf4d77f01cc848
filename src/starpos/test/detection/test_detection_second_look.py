# SPDX-License-Identifier: Apache-2.0
"""What a frame shows at a place, against the places around it."""

import numpy as np
import pytest
from scipy import ndimage

from starpos.detection import detect
from starpos.detection.second_look import SecondLook
from starpos.frames.frame import Frame
from starpos_testing.skies.rendered import field, grid, noisy

SIZE = (600, 900)


def look_at(light, rng, window=None, **more):
    return SecondLook(Frame(noisy(light, rng, **more)), window, 2.4)


def places(rng, count=1500):
    return rng.uniform(70, 830, count), rng.uniform(70, 530, count)


def cloudy(rng):
    cloud = ndimage.gaussian_filter(rng.normal(0, 1, SIZE), 40)
    return 30 + 300 * (cloud - cloud.min()) / np.ptp(cloud)


SKIES = {
    "even": lambda rng: np.full(SIZE, 30.0),
    "clouds": cloudy,
    "a gradient": lambda rng: np.linspace(20, 2000, SIZE[1]) * np.ones(SIZE),
    "stars": lambda rng: field(SIZE, grid(SIZE, 40, 3000, rng)),
    "hot pixels": lambda rng: np.where(rng.random(SIZE) < 0.01, 4000.0, 30.0),
}


@pytest.mark.parametrize("sky", SKIES)
def test_places_without_a_star_are_no_brighter_than_chance(sky, rng):
    sigmas, _ = look_at(SKIES[sky](rng), rng)(*places(rng))
    for limit, share in ((0.0, 0.5), (1.0, 0.159), (2.0, 0.0228)):
        assert np.mean(sigmas > limit) < share + 4 * np.sqrt(share / len(sigmas))


def test_a_sky_cut_off_at_zero_shows_no_stars(rng):
    counts = np.maximum(noisy(np.full(SIZE, 20.0), rng).astype(int) - 325, 0)
    sigmas, _ = SecondLook(Frame(counts.astype(np.uint8)), None, None)(*places(rng))
    assert np.mean(sigmas > 1) < 0.19


def test_stars_too_faint_to_be_detected_stand_out(rng):
    stars = grid(SIZE, 70, 65, rng)
    frame = Frame(noisy(field(SIZE, stars), rng))
    found = detect(frame).stars
    sigmas, snr = SecondLook(frame, found.window, found.fwhm_px)(stars[:, 0], stars[:, 1])
    assert len(found) < 0.2 * len(stars)
    assert np.nanmean(sigmas) > 1.3
    assert 1.3 < np.nanmean(snr) < 5


def test_wide_stars_too(rng):
    stars = grid(SIZE, 70, 220, rng)
    frame = Frame(noisy(field(SIZE, stars, fwhm=7.0), rng))
    sharp, wide = (np.nanmean(SecondLook(frame, None, fwhm)(*stars[:, :2].T)[0]) for fwhm in (2.4, 7.0))
    assert wide > sharp + 0.3


def test_the_edge_and_what_is_beyond_the_window_say_nothing(rng):
    look = look_at(np.full(SIZE, 30.0), rng, window=(0, 0, 450, 600))
    sigmas, snr = look(
        np.array([200.0, 448.0, 700.0, 2.0, -50.0]), np.array([300.0, 300.0, 300.0, 300.0, 300.0])
    )
    assert np.isfinite(sigmas).tolist() == np.isfinite(snr).tolist() == [True, False, False, False, False]


def test_white_beyond_the_window_hides_no_star_beside_it(rng):
    light = field(SIZE, np.array([[435.0, 300.0, 400.0]]))
    plane = noisy(light, rng)
    plane[:, 450:] = 65535
    sigmas, _ = SecondLook(Frame(plane), (0, 0, 450, 600), 2.4)(np.array([435.0]), np.array([300.0]))
    assert sigmas[0] > 2.5

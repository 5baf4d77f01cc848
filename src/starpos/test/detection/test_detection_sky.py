# SPDX-License-Identifier: Apache-2.0
"""Skies and sensors that are not clean: what is in the way costs only what it covers."""

import tracemalloc

import numpy as np
import pytest
from scipy import ndimage

from starpos.detection import detect
from starpos.detection.background import measure_sky
from starpos.detection.finding import find_peaks
from starpos.frames.frame import BLENDED, SATURATED, Frame, to_unsigned
from starpos_testing.skies.rendered import bound, coloured, errors, field, grid, match, noisy, rms

SIZE = (600, 900)
ELECTRONS = 12000


@pytest.fixture
def stars(rng):
    return grid(SIZE, 50, ELECTRONS, rng)


def found_in(light, rng, **more):
    return detect(Frame(noisy(light, rng, **more))).stars


def test_vignetting_shifts_no_star(stars, rng):
    y, x = np.indices(SIZE)
    light = field(SIZE, stars, sky=600) * (1 - 0.7 * np.hypot((x - 450) / 450, (y - 300) / 300) ** 2 / 2)
    found = found_in(light, rng)
    error, pull = errors(found, stars)
    assert len(found) == len(stars)
    assert 0.9 < rms(pull) < 1.1
    assert np.all(np.abs(error.mean(0)) < 0.006)


@pytest.mark.parametrize("size_px", [12, 40])
def test_clouds_make_no_star_and_their_stars_keep_their_errors(size_px, stars, rng):
    cloud = ndimage.gaussian_filter(rng.normal(0, 1, SIZE), size_px)
    cloud = (cloud - cloud.min()) / np.ptp(cloud)
    light = field(SIZE, stars, sky=0) * (1 - 0.7 * cloud) + 60 + 300 * cloud
    found = found_in(light, rng)
    _, pull = errors(found, stars)
    assert len(found) == len(stars)
    assert 0.7 < rms(pull) < 1.1


@pytest.mark.parametrize("brightness", [0, 1500, 6000])
def test_a_roof_hides_what_it_covers_and_adds_nothing(brightness, rng):
    stars = grid(SIZE, 30, ELECTRONS, rng)
    y, x = np.indices(SIZE)
    roof = y > 420 + 0.1 * x
    tiles = brightness * (1 + 0.2 * rng.random((60, 90))).repeat(10, 0).repeat(10, 1)
    found = found_in(np.where(roof, tiles, field(SIZE, stars, sky=60)), rng)
    below = stars[:, 1] - 420 - 0.1 * stars[:, 0]
    # A cell of the background's mesh.
    error, pull = errors(found, stars[below < (-64 if brightness else -15)])
    assert rms(error) < 1.15 * rms(bound(ELECTRONS, sky=60))
    assert 0.75 < rms(pull) < 1.15
    index = match(found, stars)
    assert len(found) - len(set(index[index >= 0])) <= 3


@pytest.mark.parametrize("sky", [60, 300, 1000])
def test_a_dark_roof_makes_no_star_and_hides_none_above_it(sky, rng):
    stars = grid(SIZE, 50, ELECTRONS, rng)
    y, x = np.indices(SIZE)
    found = found_in(np.where(y > 300 + 0.1 * x, 10, field(SIZE, stars, sky=sky)), rng)
    errors(found, stars[stars[:, 1] < 285 + 0.1 * stars[:, 0]])
    index = match(found, stars, within=3)
    assert len(found) == len(set(index[index >= 0]))


def tree(rng):
    """The share (0..1) of each pixel that twigs cover, below row 300 of SIZE."""
    along = np.linspace(0, 1, 500)[:, None]
    x, y, angle = rng.uniform(0, SIZE[1], 60), rng.uniform(320, SIZE[0], 60), rng.uniform(0, np.pi, 60)
    length = rng.uniform(50, 250, 60)
    column, row = x + along * length * np.cos(angle), y - 0.7 * along * length * np.sin(angle)
    inside = (column >= 0) & (column < SIZE[1]) & (row >= 300) & (row < SIZE[0])
    twigs = np.zeros(SIZE)
    twigs[row[inside].astype(int), column[inside].astype(int)] = 3
    return np.clip(ndimage.gaussian_filter(twigs, 1.6), 0, 1)


@pytest.mark.parametrize("brightness", [10, 200, 1500, 6000])
def test_a_tree_costs_what_it_covers_and_most_of_what_its_leaves_add_is_flagged(brightness, rng):
    stars = grid(SIZE, 40, ELECTRONS, rng)
    twigs = tree(rng)
    leaves = brightness * np.clip(1 + 0.4 * ndimage.gaussian_filter(rng.normal(0, 3, SIZE), 2), 0, None)
    found = found_in(field(SIZE, stars, sky=60) * (1 - twigs) + twigs * leaves, rng)
    near = ndimage.gaussian_filter(twigs, 9)[stars[:, 1].astype(int), stars[:, 0].astype(int)] > 0.02
    clear = stars[~near]
    clear = clear[match(found, clear) >= 0]
    # A twig's end may lie on one.
    assert len(clear) > 0.98 * np.count_nonzero(~near)
    error, pull = errors(found, clear)
    assert rms(error) < 1.1 * rms(bound(ELECTRONS, sky=60))
    assert 0.85 < rms(pull) < 1.1
    index = match(found, stars, within=3)
    false = np.setdiff1d(np.arange(len(found)), index)
    assert np.count_nonzero(found.flags[false] == 0) < 0.6 * len(false) or len(false) < 8
    assert np.mean(found.flags[match(found, clear)] > 0) < 0.05


@pytest.mark.parametrize("count", [5, 8, 15, 25, 40])
def test_twigs_that_outnumber_the_stars_teach_nothing(count, rng):
    stars = grid(SIZE, 24, ELECTRONS, rng)
    stars = rng.permutation(stars[stars[:, 1] < 290])[:count]
    twigs = tree(rng)
    leaves = 200 * np.clip(1 + ndimage.gaussian_filter(rng.normal(0, 1.2, SIZE), 2), 0, None)
    light = field(SIZE, stars, sky=60) * (1 - twigs) + twigs * leaves
    error, pull = errors(found_in(light, rng), stars)
    assert rms(error) < 1.3 * rms(bound(ELECTRONS, sky=60))
    assert rms(pull) < 1.3


def test_dead_rows_and_columns_cost_only_the_stars_on_them(stars, rng):
    pixels = noisy(field(SIZE, stars), rng)
    rows, columns = np.arange(30, SIZE[0], 97), np.array([130, 131, 333])
    pixels[rows], pixels[:, columns[:2]], pixels[:, columns[2]] = 0, 0, 65535
    near = np.abs(stars[:, 1, None] - rows).min(1) < 6
    near |= np.abs(stars[:, 0, None] - columns).min(1) < 6
    found = detect(Frame(pixels)).stars
    error, _ = errors(found, stars[~near])
    assert rms(error) < 1.1 * rms(bound(ELECTRONS))
    assert len(found) <= len(stars)


def test_stars_far_over_the_full_well_are_found_where_they_are(rng):
    stars = grid(SIZE, 60, lambda n: np.geomspace(3000, 3e6, n), rng)
    found = found_in(field(SIZE, stars), rng, top=4095)
    error, _ = errors(found, stars)
    full = stars[:, 2] > 6e4
    assert len(found) == len(stars)
    assert np.all(found.flags[match(found, stars[full])] & SATURATED)
    assert np.all(np.abs(error[full]) < 0.1)


@pytest.mark.montecarlo
@pytest.mark.parametrize("ratio", [1.0, 0.3])
@pytest.mark.parametrize(
    ("fwhms", "pattern"),
    [
        *((f, "") for f in (0.8, 1.0, 1.25, 1.3, 1.4, 1.6, 2.0, 2.7)),
        (0.8, "rggb"),
        (1.4, "rggb"),
        (2.0, "rggb"),
    ],
)
def test_both_stars_of_a_close_pair_are_measured(fwhms, ratio, pattern, rng):
    stars = grid(SIZE, 50, 20000, rng)
    first = stars[::3]
    angle = rng.uniform(0, 2 * np.pi, len(first))
    second = first + fwhms * 2.4 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], 1)
    second[:, 2] = 20000 * ratio
    both = np.concatenate([stars, second])
    gains, mean = (coloured(len(both), rng), np.array([[0.65, 1], [1, 0.65]])) if pattern else (None, None)
    found = detect(Frame(noisy(field(SIZE, both, gains=gains), rng), pattern=pattern)).stars
    assert len(found) == len(both)
    for some in (first, second):
        error, pull = errors(found, some)
        assert rms(error) < (1.4 if fwhms > 1.5 else 2.4) * rms(bound(some[0, 2], gain=mean))
        assert 0.75 < rms(pull) < 1.25
        # Resolved
        if fwhms > 1.5:
            assert np.count_nonzero(found.flags[match(found, some)]) < 0.2 * len(some)


def test_three_stars_in_a_row_do_not_vanish_and_their_image_is_flagged(rng):
    stars = grid(SIZE, 50, 20000, rng)
    middle = stars[::3]
    angle = rng.uniform(0, 2 * np.pi, len(middle))
    way = 1.3 * 2.4 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], 1)
    found = found_in(field(SIZE, np.concatenate([stars, middle - way, middle + way])), rng)
    index = match(found, middle, within=4)
    assert np.all(index >= 0)
    assert np.all(found.flags[index] & BLENDED)


@pytest.mark.parametrize("ratio", [0.5, 0.3])
def test_many_pairs_teach_no_false_errors(ratio, rng):
    stars, trail = grid(SIZE, 50, 20000, rng), (2.6, -2.2)
    first = stars[::3]
    angle = rng.uniform(0, 2 * np.pi, len(first))
    second = first + 2 * 2.4 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], 1)
    second[:, 2] = 20000 * ratio
    found = found_in(field(SIZE, np.concatenate([stars, second]), trail=trail), rng)
    for some in (stars, second):
        error, pull = errors(found, some)
        assert rms(error) < 1.2 * rms(bound(some[0, 2], trail=trail))
        assert 0.85 < rms(pull) < 1.15


def peaks_of(pixels):
    return find_peaks(measure_sky(pixels, 64, None), 5.0, 10_000)


def test_hot_pixels_cost_no_fit_each_and_hardly_a_star(rng):
    stars = grid(SIZE, 60, ELECTRONS, rng)
    light = noisy(field(SIZE, stars), rng).astype(int)
    hot = rng.random(SIZE) < 0.004
    light[hot] += rng.integers(100, 20_000, hot.sum())
    pixels = light.clip(0, 65535).astype(np.uint16)
    found = detect(Frame(pixels)).stars
    # A hot pixel in the midst of one may cost it.
    assert np.mean(match(found, stars) >= 0) > 0.98
    # Pairs of hot pixels stay to be looked at.
    assert len(peaks_of(pixels).x) < len(stars) + 0.4 * hot.sum()


@pytest.mark.parametrize("seed", [1, 6])
def test_pairs_of_hot_pixels_do_not_teach_how_a_star_looks(seed):
    rng, size = np.random.default_rng(seed), (1600, 1600)
    stars = grid(size, 270, ELECTRONS, rng)
    stars[:, 2] = np.minimum(500 * (1 + rng.pareto(1, len(stars))), 1e5)
    light = noisy(field(size, stars, trail=(2.6, -2.2)), rng).astype(float)
    hot = rng.random(size) < 0.003
    light[hot] += 100 + rng.exponential(2000, hot.sum())
    found = detect(Frame(light.clip(0, 65535).astype(np.uint16)))
    index = match(found.stars, stars)
    assert np.all(index >= 0) and len(found.stars) == len(stars)
    assert 2.9 < found.fwhm_px < 3.05


def test_a_disc_that_saturates_is_few_peaks_and_hides_no_star_a_cell_of_the_background_away(rng):
    stars = grid(SIZE, 50, ELECTRONS, rng)
    y, x = np.indices(SIZE)
    disc = np.hypot(x - 450, y - 300) < 150
    stars = stars[np.hypot(stars[:, 0] - 450, stars[:, 1] - 300) > 150 + 64]
    pixels = noisy(np.where(disc, 1e6, field(SIZE, stars)), rng)
    assert len(peaks_of(pixels).x) < len(stars) + 50
    assert np.all(match(detect(Frame(pixels)).stars, stars) >= 0)


@pytest.mark.parametrize("unit", [1.0, 1 / 65535], ids=["DN", "share"])
@pytest.mark.parametrize("value", [1e5, 1e7, 1e30, -1e6])
def test_a_pixel_beyond_all_light_costs_no_other_its_precision(unit, value, stars, rng):
    pixels = noisy(field(SIZE, stars), rng).astype(np.float64) * unit
    pixels[10, 10] = value
    error, _ = errors(detect(Frame(to_unsigned(pixels, "the frame"))).stars, stars)
    assert rms(error) < 1.1 * rms(bound(ELECTRONS))


def test_memory_is_less_than_two_and_a_half_frames(rng):
    size = (1155, 1732)
    frame = Frame(noisy(field(size, grid(size, 80, ELECTRONS, rng)), rng))
    # What the first call loads.
    detect(Frame(frame.pixels[:200, :200].copy()))
    tracemalloc.start()
    try:
        detect(frame)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 2.5 * frame.pixels.nbytes

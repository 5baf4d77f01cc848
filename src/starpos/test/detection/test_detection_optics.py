# SPDX-License-Identifier: Apache-2.0
"""What a frame's stars teach of its optics: a PSF that goes with the field, and one known from a star or two."""

import numpy as np
import pytest

from starpos.detection import detect
from starpos.frames.frame import Frame
from starpos_testing.skies.rendered import bound, errors, field, grid, match, noisy, rms

SIZE, TRAIL = (900, 1300), (2.6, -2.2)
FAINT, BRIGHT = 3000.0, 60000.0


@pytest.fixture
def stars(rng):
    return grid(SIZE, 65, lambda n: np.where(np.arange(n) % 2, FAINT, BRIGHT), rng)


def outwards(stars):
    """(N, 2): from the centre, of length 1 in a corner."""
    return (stars[:, :2] - [SIZE[1] / 2, SIZE[0] / 2]) / (np.hypot(*SIZE) / 2)


OPTICS = {
    "curved field": lambda way: (2.4 * (1 + 0.5 * np.sum(way**2, 1)), TRAIL),
    "tilted sensor": lambda way: (2.4 * (1 + 0.3 * way[:, 0]), TRAIL),
    "astigmatism": lambda way: (2.4, 5 * way),
}


@pytest.mark.parametrize("optics", OPTICS)
def test_images_that_go_with_the_field_are_measured_at_the_bound_and_stay_one_star_each(optics, stars, rng):
    fwhm, trail = OPTICS[optics](outwards(stars))
    found = detect(Frame(noisy(field(SIZE, stars, fwhm, trail), rng))).stars
    error, pull = errors(found, stars)
    assert len(found) == len(stars)
    assert np.count_nonzero(found.flags) < 0.03 * len(stars)
    fwhm, trail = np.broadcast_to(fwhm, len(stars)), np.broadcast_to(trail, (len(stars), 2))
    limit = np.array([bound(e, f, t) for e, f, t in zip(stars[:, 2], fwhm, trail, strict=True)])
    for electrons in (FAINT, BRIGHT):
        own = stars[:, 2] == electrons
        assert rms(error[own] / limit[own]) < 1.12
        assert 0.8 < rms(pull[own]) < 1.1


def test_coma_shifts_bright_stars_no_more_than_faint_ones(stars, rng):
    # At a corner.
    way, tail_px = outwards(stars), 1.0
    steps = (np.arange(9) + 0.5) / 3
    share = np.exp(-steps) / np.exp(-steps).sum()
    tails = [
        np.c_[stars[:, :2] + s * tail_px * way, stars[:, 2] * w] for s, w in zip(steps, share, strict=True)
    ]
    found = detect(Frame(noisy(field(SIZE, np.concatenate(tails)), rng))).stars
    error, pull = errors(found, stars)
    assert len(found) == len(stars)
    # a shift that grows outwards is distortion, which a camera's calibration holds; what depends on brightness is not
    far = np.hypot(*way.T)
    along = np.einsum("ni,ni->n", error, way) / far
    terms = np.stack([far, far**3], 1)
    shifts = []
    for electrons in (FAINT, BRIGHT):
        own = stars[:, 2] == electrons
        fit = np.linalg.lstsq(terms[own], along[own], rcond=None)[0]
        rest = error[own] - (terms[own] @ fit / far[own])[:, None] * way[own]
        # A star without a tail.
        assert rms(rest) < 1.2 * rms(bound(electrons))
        assert 0.9 < rms(rest / error[own] * pull[own]) < 1.1
        shifts.append(fit.sum())
    assert abs(shifts[1] - shifts[0]) < 0.04


def test_corners_without_a_star_to_learn_from_are_no_worse_than_the_rest(rng):
    stars = grid(SIZE, 65, BRIGHT, rng)
    middle = np.abs(stars[:, 0] - SIZE[1] / 2) < 300
    # Too faint to teach.
    faint = np.where(middle, BRIGHT, 700.0)
    stars = np.c_[stars[:, :2], faint]
    found = detect(Frame(noisy(field(SIZE, stars, 2.4 * (1 + 0.3 * outwards(stars)[:, 0])), rng))).stars
    index = match(found, stars)
    error = np.stack([found.x[index], found.y[index]], 1)[index >= 0] - stars[index >= 0, :2]
    assert np.mean(index[~middle] >= 0) > 0.9
    assert len(found) == np.sum(index >= 0)
    assert rms(error[~middle[index >= 0]]) < 1.3 * rms([bound(700.0, f) for f in (2.0, 2.8)])


@pytest.mark.montecarlo
@pytest.mark.parametrize(("count", "electrons"), [(1, 3000), (1, 100000), (2, 30000), (3, 3000), (3, 100000)])
def test_one_two_and_three_stars_are_measured_as_well_as_they_say(count, electrons, rng):
    error, pull = [], []
    for _ in range(120 // count):
        x = 30 + 40 * np.arange(count) + rng.uniform(-5, 5, count)
        stars = np.stack([x, rng.uniform(25, 95, count), np.full(count, float(electrons))], 1)
        found = detect(Frame(noisy(field((120, 140), stars, trail=TRAIL), rng))).stars
        assert len(found) == count
        e, p = errors(found, stars)
        error.append(e)
        pull.append(p)
    assert rms(np.concatenate(error)) < 1.15 * rms(bound(electrons, trail=TRAIL))
    assert 0.86 < rms(np.concatenate(pull)) < 1.14

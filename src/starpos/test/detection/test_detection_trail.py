# SPDX-License-Identifier: Apache-2.0
"""Frames of one to four stars whose trail is known: at the bound; a wrong trail is no worse than none."""

from dataclasses import replace

import numpy as np
import pytest

from starpos.detection import detect
from starpos.detection.psf import trailed
from starpos.errors import FrameError
from starpos.frames.frame import Frame
from starpos_testing.skies.rendered import bound, errors, field, grid, match, noisy, rms, star

FWHM, STARS = 2.4, 12
# px from the edges, beyond the reach of a stamp
MARGIN = 42


def turned(trail, angle):
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s], [s, c]]) @ trail


def frames(count, length, electrons, rng, number=STARS):
    """Frames of `count` stars, their trail (2,) px and the stars (count, 3), until there are enough stars."""
    for _ in range(number // count):
        trail = turned([length, 0.0], rng.uniform(0, np.pi))
        x = MARGIN + 50 * np.arange(count) + rng.uniform(-5, 5, count)
        stars = np.stack([x, rng.uniform(MARGIN, 80, count), np.full(count, float(electrons))], 1)
        size = (120, 2 * MARGIN + 50 * (count - 1))
        yield Frame(noisy(field(size, stars, FWHM, trail), rng)), trail, stars


@pytest.mark.parametrize("length", [0.0, 3.0, 8.0, 15.0])
def test_the_psf_of_a_trail_is_the_star_that_moves_along_it(length):
    trail, size = turned([length, 0.0], 0.7), 41
    sigma = np.sqrt((FWHM / 2.3548) ** 2 + 1 / 12)
    left = np.array([-20.2])
    value = trailed(sigma, trail).at(np.zeros(1), np.zeros(1)).evaluate(left, left, size)[0]
    light = star((size, size), 20.2, 20.2, FWHM, trail)
    assert value.sum() == pytest.approx(1, abs=1e-3)
    assert rms(value - light) < 0.05 * rms(light)


@pytest.mark.montecarlo
@pytest.mark.parametrize("electrons", [1500, 20000])
@pytest.mark.parametrize(("count", "length"), [(1, 5.0), (1, 10.0), (1, 15.0), (3, 10.0), (4, 15.0)])
def test_a_few_stars_with_a_known_trail_are_measured_near_the_bound(count, length, electrons, rng):
    error, pull = [], []
    for frame, trail, stars in frames(count, length, electrons, rng, 4 * STARS):
        found = detect(replace(frame, trail_px=tuple(trail))).stars
        assert len(found) == count
        e, p = errors(found, stars)
        error.append(e / rms(bound(electrons, FWHM, trail)))
        pull.append(p)
    assert rms(np.concatenate(error)) < 1.35
    assert 0.65 < rms(np.concatenate(pull)) < 1.25


WRONG = {
    "zero": lambda t: 0 * t,
    "doubled": lambda t: 2 * t,
    "turned by 90 deg": lambda t: turned(t, np.pi / 2),
}


@pytest.mark.parametrize("kind", WRONG)
@pytest.mark.parametrize("electrons", [800, 8000])
@pytest.mark.parametrize(("count", "length"), [(1, 10.0), (3, 5.0), (4, 15.0)])
def test_a_wrong_trail_is_no_worse_than_none(count, length, electrons, kind, rng):
    offs = {"none": [], "wrong": []}
    for frame, trail, stars in frames(count, length, electrons, rng):
        for which, given in (("none", None), ("wrong", tuple(WRONG[kind](trail)))):
            found = detect(replace(frame, trail_px=given)).stars
            index = match(found, stars)
            off = np.hypot(found.x[index] - stars[:, 0], found.y[index] - stars[:, 1])
            offs[which].append(np.where(index >= 0, off, 2.0))
    none, wrong = (np.concatenate(offs[which]) for which in ("none", "wrong"))
    assert rms(wrong) < 1.05 * rms(none)


def test_stars_enough_to_learn_from_decide_alone(rng):
    stars = grid((300, 400), 50, 9000, rng)
    frame = Frame(noisy(field((300, 400), stars, FWHM, (6.0, 3.0)), rng))
    alone, told = (detect(f).stars for f in (frame, replace(frame, trail_px=(6.0, 3.0))))
    for name in ("x", "y", "flux", "covariance"):
        np.testing.assert_array_equal(getattr(told, name), getattr(alone, name))


def test_without_stars_a_trail_finds_none(rng):
    frame = Frame(noisy(field((120, 140), np.zeros((0, 3))), rng), trail_px=(10.0, 3.0))
    assert len(detect(frame).stars) == 0


@pytest.mark.parametrize("trail", [(np.nan, 0.0), (0.0, np.inf), (1e9, 0.0)])
def test_what_is_no_trail_is_refused(trail):
    with pytest.raises(FrameError, match="trail"):
        Frame(np.zeros((10, 10), np.uint8), trail_px=trail)

# SPDX-License-Identifier: Apache-2.0
"""Frames whose stars' trail is known: of one to four stars, and of a camera that rolls; a wrong trail does no harm."""

from dataclasses import replace

import numpy as np
import pytest

from starpos.detection import detect
from starpos.detection.psf import trailed
from starpos.errors import FrameError
from starpos.frames.exposure import Trail
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
    psf = trailed(sigma, Trail(middle_px=tuple(trail)), 100, 100)
    value = psf.at(np.zeros(1), np.zeros(1)).evaluate(left, left, size)[0]
    light = star((size, size), 20.2, 20.2, FWHM, trail)
    assert value.sum() == pytest.approx(1, abs=1e-3)
    assert rms(value - light) < 0.05 * rms(light)


@pytest.mark.montecarlo
@pytest.mark.parametrize(
    ("count", "length", "electrons"),
    [(1, 5.0, 1500), (1, 10.0, 20000), (1, 15.0, 1500), (3, 10.0, 20000), (4, 15.0, 1500)],
)
def test_a_few_stars_with_a_known_trail_are_measured_near_the_bound(count, length, electrons, rng):
    error, pull = [], []
    for frame, trail, stars in frames(count, length, electrons, rng, 2 * STARS):
        found = detect(replace(frame, trail=Trail(middle_px=tuple(trail)))).stars
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


def off_px(frame, trail, stars):
    """How far the stars (N, 3) of a frame are found from where they are; 2 px for those that are lost."""
    found = detect(replace(frame, trail=trail)).stars
    index = match(found, stars)
    off = np.hypot(found.x[index] - stars[:, 0], found.y[index] - stars[:, 1])
    return np.where(index >= 0, off, 2.0)


@pytest.mark.parametrize("kind", WRONG)
@pytest.mark.parametrize(
    ("count", "length", "electrons"), [(1, 10.0, 800), (3, 5.0, 8000), (4, 15.0, 800), (4, 15.0, 8000)]
)
def test_a_wrong_trail_is_no_worse_than_none(count, length, electrons, kind, rng):
    none, wrong = [], []
    for frame, trail, stars in frames(count, length, electrons, rng):
        none.append(off_px(frame, None, stars))
        wrong.append(off_px(frame, Trail(middle_px=tuple(WRONG[kind](trail))), stars))
    assert rms(wrong) < 1.05 * rms(none)


def test_stars_enough_to_learn_from_decide_alone(rng):
    stars = grid((300, 400), 50, 9000, rng)
    frame = Frame(noisy(field((300, 400), stars, FWHM, (6.0, 3.0)), rng))
    alone, told = (detect(f).stars for f in (frame, replace(frame, trail=Trail(middle_px=(6.0, 3.0)))))
    for name in ("x", "y", "flux", "covariance"):
        np.testing.assert_array_equal(getattr(told, name), getattr(alone, name))


def rolled(number, roll, rng, fwhm=FWHM, size=(400, 600)):
    """A frame of a camera that rolled by an angle, rad, about its axis, and its stars (number, 3)."""
    rows, columns = np.divmod(np.arange(number), 6)
    place = np.stack([60 + 96 * columns, 60 + 380 * rows * 6 / number], 1) + rng.uniform(-15, 15, (number, 2))
    stars = np.column_stack([place, 10 ** rng.uniform(3.6, 4.8, number)])
    away = place - [(size[1] - 1) / 2, (size[0] - 1) / 2]
    trails = roll * np.stack([-away[:, 1], away[:, 0]], 1)
    return Frame(noisy(field(size, stars, fwhm, trails), rng)), stars, trails


@pytest.mark.montecarlo
@pytest.mark.parametrize(
    ("number", "roll", "fwhm"), [(6, 0.03, 1.6), (24, 0.03, 2.4), (24, 0.05, 2.4), (24, 0.05, 4.0)]
)
def test_stars_of_a_camera_that_rolls_are_measured_near_the_bound(number, roll, fwhm, rng):
    """Trails of up to 18 px, each of its own length and direction."""
    error, pull = [], []
    for _ in range(3):
        frame, stars, trails = rolled(number, roll, rng, fwhm)
        found = detect(replace(frame, trail=Trail(middle_px=(0.0, 0.0), roll_rad=roll))).stars
        assert len(found) == number
        e, p = errors(found, stars)
        best = [bound(n, fwhm, way) for n, way in zip(stars[:, 2], trails, strict=True)]
        error.append(np.median(np.abs(e / best)) / 0.6745)
        pull.append(p)
    assert np.mean(error) < 1.5
    assert 0.4 < rms(np.concatenate(pull)) < 1.3


def test_without_the_roll_stars_are_lost(rng):
    frame, stars, _ = rolled(24, 0.05, rng)
    known = Trail(middle_px=(0.0, 0.0), roll_rad=0.05)
    alone, told = (detect(replace(frame, trail=trail)).stars for trail in (None, known))
    assert np.sum(match(alone, stars) >= 0) < 24
    assert np.all(match(told, stars) >= 0) and len(told) == 24


@pytest.mark.parametrize("told", [0.0, 0.003, 0.3])
def test_a_wrong_roll_is_no_worse_than_none(told, rng):
    none, wrong = [], []
    for _ in range(6):
        frame, stars, _ = rolled(12, 0.01, rng)
        none.append(off_px(frame, None, stars))
        wrong.append(off_px(frame, Trail(middle_px=(0.0, 0.0), roll_rad=told), stars))
    assert rms(wrong) < 1.05 * rms(none)


def test_without_stars_a_trail_finds_none(rng):
    frame = Frame(noisy(field((120, 140), np.zeros((0, 3))), rng), trail=Trail(middle_px=(10.0, 3.0)))
    assert len(detect(frame).stars) == 0


@pytest.mark.parametrize(
    ("trail", "roll"),
    [((np.nan, 0.0), 0.0), ((0.0, np.inf), 0.0), ((1e9, 0.0), 0.0), ((0.0, 0.0), np.nan), ((0.0, 0.0), 4.0)],
)
def test_what_is_no_trail_is_refused(trail, roll):
    with pytest.raises(FrameError, match="trail"):
        Trail(middle_px=trail, roll_rad=roll)

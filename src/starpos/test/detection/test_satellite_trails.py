# SPDX-License-Identifier: Apache-2.0
"""Trails on drawn frames: both ends with honest errors, and what is no trail."""

import numpy as np
import pytest

from starpos.detection import detect
from starpos.detection.trails import find_trails
from starpos.frames.frame import Frame

WIDTH, HEIGHT, SIGMA, SKY = 480, 320, 1.1, 230.0


def drawn(seed, trails=(), stars=(), shine=np.ones_like):
    """A frame of trails (x, y, x, y, light per px) and stars (x, y, light): sums of Gaussians, photon and read noise."""
    rng = np.random.default_rng(seed)
    points = [np.array(stars, float).reshape(-1, 3)]
    for x0, y0, x1, y1, per_px in trails:
        u = (np.arange(int(4 * np.hypot(x1 - x0, y1 - y0))) + 0.5) / int(4 * np.hypot(x1 - x0, y1 - y0))
        points.append(np.stack([x0 + u * (x1 - x0), y0 + u * (y1 - y0), shine(u) * per_px / 4], -1))
    x, y, much = np.concatenate(points).T[..., None]
    across, down = (np.exp(-0.5 * ((np.arange(n) - c) / SIGMA) ** 2) for n, c in ((WIDTH, x), (HEIGHT, y)))
    light = SKY + (down * much).T @ across / (2 * np.pi * SIGMA**2)
    noisy = rng.poisson(light) + rng.normal(0, 3, light.shape)
    return Frame(np.clip(noisy, 0, 65535).astype(np.uint16))


def trails_on(trails, stars=(), seed=1, **drawing):
    """The trails found on a drawn frame of these and of a field of stars."""
    rng = np.random.default_rng(seed + 100)
    field = np.column_stack([rng.uniform(0, WIDTH, 40), rng.uniform(0, 50, 40), 10 ** rng.uniform(3, 4, 40)])
    stars = np.concatenate([field, np.array(stars).reshape(-1, 3)])
    frame = drawn(seed, trails, stars, **drawing)
    return find_trails(frame, detect(frame).stars, *stars.T)


def off(trail, truth):
    """The errors (4,) of a trail's ends, in the order of the truth."""
    ends = np.array(truth[:4]).reshape(2, 2)
    if np.hypot(*(trail.ends[0] - ends[0])) > np.hypot(*(trail.ends[1] - ends[0])):
        ends = ends[::-1]
    return (trail.ends - ends).ravel()


def test_errors_of_both_ends_are_as_claimed():
    rng, chi2 = np.random.default_rng(3), []
    for seed in range(8):
        angle, x, y = rng.uniform(0, np.pi), rng.uniform(100, 380), rng.uniform(90, 230)
        dx, dy = 40 * np.cos(angle), 40 * np.sin(angle)
        truth = (x - dx, y - dy, x + dx, y + dy, 60 * 10 ** rng.uniform(0, 1))
        (trail,) = trails_on([truth], seed=seed)
        error = off(trail, truth)
        chi2.append(error @ np.linalg.solve(trail.covariance, error))
        assert trail.steady and not trail.cut.any()
        assert np.sqrt(np.trace(trail.covariance)) < 1.6
    # of 32 numbers: 4 each, +- 3 standard deviations of the mean
    assert 1.5 < np.mean(chi2) < 7.0


def test_a_star_over_an_end_widens_that_end_alone():
    truth, star = (150.0, 160.0, 250.0, 160.0, 300.0), (251.0, 160.0, 9000.0)
    (trail,) = trails_on([truth], [star])
    right = int(trail.ends[:, 0].argmax())
    stddev = np.sqrt(np.diag(trail.covariance))[::2]
    assert stddev[right] > 2.0 and stddev[1 - right] < 0.3
    assert np.abs(off(trail, truth)[::2][right]) < 3 * stddev[right]


def test_two_trails_that_cross_are_two():
    truths = (100.0, 100.0, 300.0, 200.0, 200.0), (200.0, 80.0, 220.0, 240.0, 150.0)
    found = trails_on(truths)
    assert len(found) == 2
    for truth in truths:
        best = min(found, key=lambda t: np.abs(off(t, truth)).max())
        assert np.abs(off(best, truth)).max() < 1.0


def test_a_saturated_trail_has_ends():
    truth = (100.0, 100.0, 260.0, 150.0, 400_000.0)
    (trail,) = trails_on([truth])
    assert np.abs(off(trail, truth)).max() < 1.0


def test_a_trail_that_leaves_the_frame_is_cut_there():
    (trail,) = trails_on([(-60.0, 100.0, 120.0, 160.0, 200.0)])
    left = int(trail.ends[:, 0].argmin())
    assert trail.cut[left] and not trail.cut[1 - left]


@pytest.mark.parametrize(
    "shine", [lambda u: (np.floor(6 * u) % 2 == 0) * 1.0, lambda u: np.exp(-0.5 * ((u - 0.6) / 0.15) ** 2)]
)
def test_an_aircraft_s_lamp_and_a_flash_are_not_steady(shine):
    found = trails_on([(80.0, 80.0, 300.0, 240.0, 300.0)], shine=shine)
    assert not any(trail.steady for trail in found)


def test_stars_are_no_trails():
    rng = np.random.default_rng(7)
    light = 10 ** rng.uniform(2.6, 5, 150)
    stars = np.column_stack([rng.uniform(0, WIDTH, 150), rng.uniform(0, HEIGHT, 150), light])
    frame = drawn(6, stars=stars)
    # half of them are known
    assert not find_trails(frame, detect(frame).stars, *stars[::2].T)

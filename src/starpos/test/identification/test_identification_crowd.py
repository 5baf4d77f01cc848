# SPDX-License-Identifier: Apache-2.0
"""Fields under a crowd of brighter false stars, and fields whose order of brightness is not to be trusted."""

import time

import numpy as np
import pytest
from crowds import CAMERA, SIGMA_PX, identified, stars_on, under

from starpos.identification import PointingPrior
from starpos.rotation import about_axis
from starpos_testing.skies.scenes import random_attitude


def found_in(xy, sky, priors=()):
    return identified(xy, np.full(len(xy), SIGMA_PX), CAMERA, sky, priors)


def assert_looks(found, attitude):
    assert np.linalg.norm(found.attitude[2] - attitude[2]) < 0.5 / CAMERA.fx


@pytest.mark.parametrize("crowd", [20, 50, 100])
def test_fields_are_found_under_so_many_brighter_false_stars(crowd, sky, rng):
    found = fields = 0
    while fields < 5:
        attitude = random_attitude(rng)
        xy = stars_on(sky, attitude, rng)
        if len(xy) >= 8:
            fields += 1
            answer = found_in(under(crowd, xy, rng), sky)
            if answer is not None:
                assert_looks(answer, attitude)
                assert answer.star.min() >= 0
                found += 1
    assert found >= 4


def test_fields_are_found_among_more_false_stars_as_bright_as_theirs(sky, rng):
    found = fields = 0
    while fields < 5:
        attitude = random_attitude(rng)
        xy = stars_on(sky, attitude, rng)[:20]
        if len(xy) >= 8:
            fields += 1
            mixed = rng.permutation(len(xy) + 30)
            answer = found_in(under(30, xy, rng)[mixed], sky)
            if answer is not None:
                assert_looks(answer, attitude)
                assert mixed[answer.star].min() >= 30
                found += 1
    assert found >= 4


def test_fields_are_found_beside_lights_that_fill_a_part_of_the_frame(sky, rng):
    """A town's windows, or an aeroplane's trail: more lights than are looked at, all of them brighter than any star."""
    found = fields = 0
    while fields < 5:
        attitude = random_attitude(rng)
        xy = stars_on(sky, attitude, rng)
        xy = xy[xy[:, 1] < 0.8 * CAMERA.height]
        if len(xy) >= 15:
            fields += 1
            town = rng.uniform([0, 0.82 * CAMERA.height], [CAMERA.width - 1, CAMERA.height - 1], (300, 2))
            answer = found_in(np.concatenate([town, xy]), sky)
            if answer is not None:
                assert_looks(answer, attitude)
                assert answer.star.min() >= 300
                found += 1
    assert found >= 4


def test_lights_that_fill_a_part_of_the_frame_are_no_sky(sky, rng):
    town = rng.uniform([0, 0.7 * CAMERA.height], [CAMERA.width - 1, CAMERA.height - 1], (300, 2))
    for _ in range(5):
        stray = rng.uniform(0, [CAMERA.width - 1, CAMERA.height - 1], (30, 2))
        assert found_in(np.concatenate([town, stray]), sky) is None


def test_a_prior_finds_a_field_under_a_hundred_brighter_false_stars_where_a_few_true_ones_are_left(sky, rng):
    for _ in range(3):
        attitude = random_attitude(rng)
        xy = stars_on(sky, attitude, rng)[:12]
        if len(xy) < 8:
            continue
        near = PointingPrior(about_axis(0, 3 / CAMERA.fx) @ attitude, CAMERA.fx)
        assert_looks(found_in(under(100, xy, rng), sky, [near]), attitude)


def test_points_without_a_sky_are_refused_in_bounded_time(sky, rng):
    begin = time.process_time()
    for number in (40, 300):
        assert found_in(under(number, np.zeros((0, 2)), rng), sky) is None
    assert time.process_time() - begin < 30


def test_the_order_of_brightness_does_not_decide(sky, rng):
    """Clipped stars, coloured filters and variable stars come in any order."""
    for _ in range(4):
        attitude = random_attitude(rng)
        xy = rng.permutation(stars_on(sky, attitude, rng)[:60])
        if len(xy) >= 15:
            assert_looks(found_in(xy, sky), attitude)

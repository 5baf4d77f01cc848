# SPDX-License-Identifier: Apache-2.0
"""Fields under a crowd of brighter false stars, and fields whose order of brightness is not to be trusted."""

import time

import numpy as np
import pytest

from starpos.identification import PointingPrior, Sky, identify, triangle_cache
from starpos.instrument.camera import Camera
from starpos.rotation import about_axis

# the paper's field, pixels binned by four
CAMERA, LIMIT = Camera.from_focal(1404, 936, 23437.5), 8.8
SIGMA_PX = 0.05


@pytest.fixture(scope="module")
def sky(catalogue):
    return Sky(catalogue, triangle_cache.cached(catalogue, CAMERA.half_diagonal_rad))


def random_attitude(rng):
    q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    return q * np.linalg.det(q)


def stars_on(sky, attitude, rng):
    """Pixels (N, 2) of the catalogue's stars on the frame, brightest first."""
    index = sky.catalogue.cone(attitude[2], CAMERA.half_diagonal_rad * 1.05, LIMIT)
    xy = CAMERA.project(sky.directions(index) @ attitude.T)
    on = (xy >= 0).all(1) & (xy <= [CAMERA.width - 1, CAMERA.height - 1]).all(1)
    return xy[on] + rng.normal(0, SIGMA_PX, (on.sum(), 2))


def under(crowd, xy, rng):
    return np.concatenate([rng.uniform(0, [CAMERA.width - 1, CAMERA.height - 1], (crowd, 2)), xy])


def found_in(xy, sky, priors=()):
    return identify(xy, np.full(len(xy), SIGMA_PX), CAMERA, sky, priors)


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

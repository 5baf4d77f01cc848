# SPDX-License-Identifier: Apache-2.0
"""What compiled code keeps as plain memory: it takes arrays that fit only, and gives what it was given."""

import pickle

import numpy as np
import pytest

from starpos.identification import Identification, search
from starpos.identification.pose import stars_at
from starpos.instrument.camera import Camera

CAMERA = Camera.from_focal(100, 80, 1e3)
VALUES = {
    "star": [0, 2, 5],
    "catalogue": [700, 30, 41],
    "blend_px": [0.0, 0.25, 0.0],
    "attitude": np.eye(3)[[1, 2, 0]],
    "focal_scale": 1.01,
    "residual_px": 0.07,
    "mean_square_px2": 0.005,
    "log_odds": 88.0,
    "expected": [30, 41, 700, 12],
    "mirrored": True,
}


def same(found, values):
    return all(np.array_equal(getattr(found, name), value) for name, value in values.items())


def test_an_identification_gives_what_it_was_given_also_from_another_process():
    found = Identification(**VALUES)
    assert same(found, VALUES)
    assert same(pickle.loads(pickle.dumps(found)), VALUES)
    assert same(found.but(star=[1, 2, 3], mirrored=False), VALUES | {"star": [1, 2, 3], "mirrored": False})
    assert same(found, VALUES)


def test_an_identification_of_none_has_empty_arrays():
    none = VALUES | {"star": [], "catalogue": [], "blend_px": [], "expected": []}
    assert same(Identification(**none), none)


@pytest.mark.parametrize(
    ("wrong", "sentence"),
    [
        ({"star": [0, 2]}, "^2 stars, 3 rows and 3 blends"),
        ({"catalogue": [1, 2, 3, 4]}, "^3 stars, 4 rows and 3 blends"),
        ({"blend_px": [0.1]}, "^3 stars, 3 rows and 1 blends"),
        ({"attitude": np.eye(2)}, "reshape"),
    ],
)
def test_arrays_of_an_identification_that_do_not_fit_are_refused(wrong, sentence):
    with pytest.raises(ValueError, match=sentence):
        Identification(**VALUES | wrong)


def test_the_stars_of_a_frame_are_what_was_given_and_a_copy():
    given, sigma = np.arange(6.0).reshape(3, 2), np.array([0.1, 0.2, 0.3])
    stars = stars_at(CAMERA, given.copy(), sigma.copy())
    taken = stars.of_rows(np.array([2, 0]))
    assert len(stars) == 3
    assert len(taken) == 2
    from_axis = given - [49.5, 39.5]
    np.testing.assert_allclose(stars.xy, [from_axis, from_axis * [1, -1]])
    assert np.array_equal(stars.sigma, sigma)
    assert np.array_equal(taken.xy, stars.xy[:, [2, 0]])
    assert np.array_equal(taken.sigma, sigma[[2, 0]])
    assert np.array_equal(stars.but(tested=5).xy, stars.xy)


@pytest.mark.parametrize("seen", [np.zeros((3, 2)), np.full((4, 2), np.nan), -np.eye(4)[:, :3]])
def test_what_is_no_place_of_a_star_on_a_frame_is_refused(seen):
    with pytest.raises(ValueError, match="finite pixels and errors"):
        stars_at(CAMERA, seen, np.ones(4))


def test_a_search_of_no_stage_or_of_too_many_is_refused(sky):
    stars = stars_at(CAMERA, np.zeros((5, 2)), np.ones(5))
    for stages in ([], [(5, 0.3)] * 9):
        with pytest.raises(ValueError, match=f"^{len(stages)} stages"):
            next(search.near_or_lost(stars, sky, (), stages))

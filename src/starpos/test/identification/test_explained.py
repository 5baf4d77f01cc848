# SPDX-License-Identifier: Apache-2.0
"""How much of a frame an answer explains: false stars and clouds are distinguished from a wrong answer."""

from dataclasses import replace

import numpy as np
import pytest
from crowds import CAMERA, SIGMA_PX, identified, stars_on, under

from starpos.fix.solution import TWO_SKIES, UNEXPLAINED, Status
from starpos.fix.solver import Solver
from starpos.frames.frame import Stars
from starpos.identification.evidence import Explained, explained_by
from starpos.identification.pose import stars_at
from starpos.instrument.instrument import Instrument
from starpos_testing.skies.scenes import random_attitude, solver_of, stars_of, tilt_of, wide_scene


@pytest.fixture
def field(sky, rng):
    """Pixels (N, 2) of a field of 15 stars or more."""
    while len(xy := stars_on(sky, random_attitude(rng), rng)) < 15:
        pass
    return xy


def explained(xy, sky):
    sigma = np.full(len(xy), SIGMA_PX)
    return explained_by(identified(xy, sigma, CAMERA, sky), stars_at(CAMERA, xy, sigma))


def test_a_clear_frame_is_explained_and_all_its_stars_are_there(field, sky):
    e = explained(field, sky)
    assert e.explained == e.bright and e.seen >= e.due - 1 and e.enough


def test_a_crowd_of_false_stars_does_not_hide_that_all_bright_stars_are_there(field, sky, rng):
    e = explained(under(20, field, rng), sky)
    assert e.explained < e.bright - 10 and e.seen >= e.due - 1 and e.enough


def test_behind_a_cloud_stars_are_missing_but_all_detections_are_explained(field, sky):
    e = explained(field[field[:, 0] < 0.6 * CAMERA.width], sky)
    assert e.explained == e.bright and e.seen < 0.9 * e.due and e.enough


def test_what_is_neither_explained_nor_there_is_not_enough():
    assert not Explained(10, 50, 4, 10).enough
    assert Explained(25, 50, 4, 10).enough and Explained(10, 50, 6, 10).enough


def test_an_answer_that_leaves_the_frame_unexplained_has_a_warning_and_gives_no_fix(
    catalogue, monkeypatch, rng
):
    scene = wide_scene()
    once, tilt = stars_of(scene, catalogue, rng), tilt_of(scene, rng)
    monkeypatch.setattr("starpos.fix.solution.explained_by", lambda *_: Explained(10, 50, 4, 10))
    s = solver_of(scene, catalogue).solve(once, tilt)
    assert s.status is Status.POOR_FIT and s.warnings == (UNEXPLAINED,) and s.fix is None
    assert "only 10 of its 50 brightest detections" in s.message


@pytest.mark.parametrize("apart_px", [6.0, 9.0])
def test_an_answer_between_two_skies_a_few_pixels_apart_has_a_warning(apart_px, field, catalogue, rng):
    """Half of the stars are moved: the pose that fits best lies between."""
    moved = (
        field
        + rng.normal(0, 1.0, field.shape)
        + np.where(np.arange(len(field))[:, None] % 2, [apart_px, 0], 0)
    )
    stars = Stars(
        x=moved[:, 0],
        y=moved[:, 1],
        flux=np.arange(len(field), 0, -1.0),
        snr=np.full(len(field), 20.0),
        covariance=np.broadcast_to(np.eye(2), (len(field), 2, 2)),
        flags=np.zeros(len(field)),
        width=CAMERA.width,
        height=CAMERA.height,
    )
    solver = Solver(Instrument(CAMERA.fx), catalogue)
    s = solver.identify(stars)
    assert not s.ok or TWO_SKIES in s.warnings
    still = replace(stars, x=field[:, 0], y=field[:, 1])
    assert solver.identify(still).warnings == ()

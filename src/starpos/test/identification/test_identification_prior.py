# SPDX-License-Identifier: Apache-2.0
"""Priors: they say where to look first, and cannot make a wrong answer."""

import numpy as np
import pytest
from crowds import identified
from test_identification import FIELDS, check, seen, sky_for

from starpos import rotation
from starpos.identification import PlumbPrior, PointingPrior, search
from starpos.units import ARCSEC
from starpos_testing.skies.scenes import START, random_attitude, solver_of, stars_of, tilt_of, wide_scene


@pytest.fixture
def field(catalogue, rng):
    """A sky, its camera, an attitude and what is seen: pixels, their errors, which stars they are."""
    camera, limit = FIELDS["15 deg"]
    sky = sky_for(catalogue, camera)
    attitude = random_attitude(rng)
    xy, index = seen(sky, camera, attitude, limit, rng)
    return sky, camera, attitude, xy, np.full(len(xy), 0.05), index


@pytest.fixture
def not_lost(monkeypatch):
    """The search of the whole sky may not be called."""
    monkeypatch.setattr(search, "anywhere", lambda *_: pytest.fail("lost in space"))


def turned(attitude, rng, angle_rad):
    axis = rng.normal(size=3)
    return rotation.from_vector(axis / np.linalg.norm(axis) * angle_rad) @ attitude


def test_a_camera_that_stands_is_not_lost(field, not_lost):
    sky, camera, attitude, xy, sigma, index = field
    check(
        identified(xy, sigma, camera, sky, [PointingPrior(attitude, camera.fx)]), attitude, index, camera, sky
    )


def test_one_that_was_knocked_is_not_lost(field, rng, not_lost):
    sky, camera, attitude, xy, sigma, index = field
    for arcmin in (3, 10, 20):
        prior = PointingPrior(turned(attitude, rng, arcmin * 60 * ARCSEC), camera.fx)
        check(identified(xy, sigma, camera, sky, [prior]), attitude, index, camera, sky)


def test_one_that_was_turned_about_the_plumb_line_is_not_lost(field, rng, not_lost):
    sky, camera, attitude, xy, sigma, index = field
    for zenith_distance in (0.2, 0.7, 1.4):
        zenith = turned(attitude, rng, zenith_distance)[2]
        prior = PlumbPrior(zenith, turned(np.eye(3), rng, 60 * ARCSEC) @ attitude @ zenith, 90 * ARCSEC)
        check(identified(xy, sigma, camera, sky, [prior]), attitude, index, camera, sky)


def test_a_prior_gives_the_same_answer_as_none(field):
    sky, camera, attitude, xy, sigma, _ = field
    lost, led = (
        identified(xy, sigma, camera, sky, priors) for priors in ([], [PointingPrior(attitude, camera.fx)])
    )
    np.testing.assert_array_equal(lost.star, led.star)
    np.testing.assert_array_equal(lost.catalogue, led.catalogue)
    np.testing.assert_array_equal(lost.attitude, led.attitude)
    assert (lost.focal_scale, lost.residual_px) == (led.focal_scale, led.residual_px)
    np.testing.assert_array_equal(lost.blend_px, led.blend_px)


@pytest.mark.parametrize(
    "kind",
    [
        "elsewhere",
        "beside",
        "rolled",
        "behind",
        "a speck of sky",
        "a drop",
        "another zenith",
        "no star there",
    ],
)
def test_a_wrong_prior_falls_back_to_the_whole_sky(field, rng, kind):
    sky, camera, attitude, xy, sigma, index = field
    wrong = {
        "elsewhere": PointingPrior(random_attitude(rng), camera.fx),
        "beside": PointingPrior(turned(attitude, rng, 0.05), camera.fx),
        "rolled": PointingPrior(rotation.about_axis(2, 0.3) @ attitude, camera.fx),
        "behind": PointingPrior(np.diag([1.0, -1.0, -1.0]) @ attitude, camera.fx),
        "a speck of sky": PointingPrior(attitude, 1e300),
        "a drop": PointingPrior(attitude, 1e-300),
        "another zenith": PlumbPrior(random_attitude(rng)[2], np.array([0.0, 0.6, 0.8]), 90 * ARCSEC),
        "no star there": PlumbPrior(random_attitude(rng)[2], np.array([0.0, 0.0, 1.0]), 1e-9),
    }[kind]
    check(identified(xy, sigma, camera, sky, [wrong, wrong]), attitude, index, camera, sky)


def test_with_a_prior_four_stars_are_enough(field):
    sky, camera, attitude, xy, sigma, index = field
    few = [0, 5, 9, 14]
    assert identified(xy[few], sigma[few], camera, sky) is None
    answer = identified(xy[few], sigma[few], camera, sky, [PointingPrior(attitude, camera.fx)])
    check(answer, attitude, index[few], camera, sky)


def test_random_points_stay_nothing_whatever_the_prior_says(field, rng):
    sky, camera, attitude, *_ = field
    priors = [
        PointingPrior(attitude, camera.fx),
        PlumbPrior(attitude[0], np.array([0.6, 0.0, 0.8]), 90 * ARCSEC),
    ]
    for n in (4, 5, 6, 8, 15, 40):
        for _ in range(5):
            xy = rng.uniform(0, [camera.width - 1, camera.height - 1], (n, 2))
            assert identified(xy, np.full(n, 0.05), camera, sky, priors) is None


def test_the_next_frame_of_a_fix_is_not_lost(catalogue, rng, monkeypatch):
    """Hours later the sky has turned on; the camera still stands, or has been turned to another azimuth."""
    scene = wide_scene()
    solver = solver_of(scene, catalogue)
    first = solver.solve(stars_of(scene, catalogue, rng), tilt_of(scene, rng))
    monkeypatch.setattr(search, "anywhere", lambda *_: pytest.fail("lost in space"))
    later = START + 2.5 * 3600
    moved = wide_scene(pointing_deg=(210.0, 78.0, 15.0))
    for now in (scene, moved):
        answer = solver.solve(stars_of(now, catalogue, rng, later), tilt_of(now, rng, later), first.hint)
        assert answer.ok
        north = abs(answer.fix.latitude - np.radians(scene.site.latitude_deg))
        assert north < 5 * np.sqrt(answer.fix.covariance[1, 1]) / 6.36e6

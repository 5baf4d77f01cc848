# SPDX-License-Identifier: Apache-2.0
"""The evidence for an identification: no larger by chance than it says, and as large as the stars allow."""

import numpy as np
import pytest
from test_identification import random_attitude, sky_for

from starpos import rotation
from starpos.camera import Camera
from starpos.identification import Plumb, Pointing, full, identify
from starpos.identification.evidence import DOUBLE_PX, LOG_SHARES, Prior, anywhere, log_evidence
from starpos.identification.pose import Pose, directions, slopes
from starpos.montecarlo import Conditions, draw

# so few pixels that chance has a chance
SMALL = Camera.from_focal(300, 225, 375 / 2 / np.tan(np.radians(5.5)))
AREA_PX2 = 300.0 * 225
SIGMA_PX = 0.05
FOUR_STARS = 3360, 4849, 5625, 7250, 7450, 10342, 11075, 11546


@pytest.fixture
def weighed(monkeypatch):
    """The evidence of all that is tried, none of which is accepted."""
    seen = []

    def watched(*given):
        seen.append(log_evidence(*given))
        return -np.inf

    monkeypatch.setattr(full, "log_evidence", watched)
    return seen


def largest(fields, rng, catalogue, weighed, priors=tuple):
    """The largest evidence of each of so many fields of random points."""
    sky, best = sky_for(catalogue, SMALL), []
    for _ in range(fields):
        n = int(rng.integers(5, 10))
        weighed.clear()
        identify(rng.uniform(0, [299, 224], (n, 2)), np.full(n, SIGMA_PX), SMALL, sky, priors())
        best.append(max(weighed, default=-np.inf))
    return np.array(best)


def test_over_random_points_it_rises_no_further_than_chance_allows(catalogue, rng, weighed):
    """Ville: a likelihood ratio exceeds x at most once in x, all hypotheses of a frame taken together."""
    best = largest(80, rng, catalogue, weighed)
    for x in (1, 2, 3, 4):
        allowed = np.exp(-x)
        assert np.mean(best > x) < allowed + 3 * np.sqrt(allowed / len(best))
    assert np.mean(best > -8) > 0.05  # or the test would not see anything


def test_a_prior_raises_it_no_further(catalogue, rng, weighed):
    def priors():
        return Pointing(random_attitude(rng), SMALL.fx), Plumb(random_attitude(rng)[2], np.eye(3)[2], 4e-4)

    best = largest(60, rng, catalogue, weighed, priors)
    for x in (1, 2, 3, 4):
        allowed = np.exp(-x)
        assert np.mean(best > x) < allowed + 3 * np.sqrt(allowed / len(best))


def scene(rng, stars=12):
    """The pose fitted to stars on a frame, their directions (N, 3), brightest first, and where they are seen."""
    made = Pose(random_attitude(rng), 2000.0, False)
    xy = rng.uniform([-150, -112], [150, 112], (stars, 2))
    w = directions(xy[None], np.array([made.focal_px]))[0] @ made.attitude
    xy = xy + rng.normal(0, SIGMA_PX, xy.shape)
    return made.fitted(xy, w, np.full(stars, SIGMA_PX)), w, xy


def evidence(pose, w, xy, star=None, rank=None, prior=None):
    star = np.arange(len(w)) if star is None else star
    rank = np.arange(len(w)) if rank is None else rank
    sigma = np.full(len(xy), SIGMA_PX)
    return log_evidence(xy, sigma, AREA_PX2, pose, prior or anywhere(2000.0), star, rank, w)


def test_it_is_the_integral_over_the_poses(rng):
    """Against the same integral by importance sampling, of five stars in order, none false."""
    pose, w, xy = scene(rng, 5)
    n = np.arange(5)
    false, right = 1 / (n + 3), (n + 2) / (n + 3) / 2
    slope = slopes(pose, w)[1].reshape(-1, 4) / SIGMA_PX
    wide = 1.2 * np.linalg.cholesky(np.linalg.inv(slope.T @ slope))
    terms = []
    for z in rng.normal(size=(4000, 4)):
        d = wide @ z
        moved = Pose(rotation.from_vector(d[:3]) @ pose.attitude, pose.focal_px * np.exp(d[3]), False)
        apart2 = np.square(xy - moved.project(w)).sum(1) / SIGMA_PX**2
        odds = false + right * AREA_PX2 / (2 * np.pi * SIGMA_PX**2) * np.exp(-apart2 / 2)
        drawn = -z @ z / 2 - 2 * np.log(2 * np.pi) - np.log(np.linalg.det(wide))
        terms.append(np.log(odds).sum() + anywhere(2000.0).log_density(moved) - drawn)
    integral = np.log(np.mean(np.exp(np.array(terms) - max(terms)))) + max(terms)
    assert evidence(pose, w, xy) == pytest.approx(integral + LOG_SHARES[0], abs=0.15)


def test_each_star_that_was_passed_over_counts_against_it(rng):
    pose, w, xy = scene(rng)
    all_seen = evidence(pose, w, xy)
    one_missed = evidence(pose, w, xy, rank=np.r_[0:6, 7:13])
    assert all_seen - one_missed == pytest.approx(6 * np.log(3))  # of six stars one brighter was not seen


def test_a_false_star_costs_and_a_crowd_of_them_costs_little_more(rng):
    pose, w, xy = scene(rng)
    worth = []
    for false in (0, 1, 5, 10):
        seen = np.concatenate([rng.uniform([-150, -112], [150, 112], (false, 2)), xy])
        worth.append(evidence(pose, w, seen, star=false + np.arange(len(w))))
    costs = -np.diff(worth)
    assert (costs > 0.5).all() and sum(costs) < 15


def test_a_detection_upon_another_says_nothing(rng):
    pose, w, xy = scene(rng, 6)
    beside = xy[0] + DOUBLE_PX * np.array([0.6, 0.0])
    doubled = evidence(pose, w, np.insert(xy, 1, beside, 0), star=np.r_[0, 2:7])
    assert evidence(pose, w, xy) - 3 < doubled < evidence(pose, w, xy)


def test_a_pose_that_the_prior_excludes_is_worth_nothing(rng):
    pose, w, xy = scene(rng)
    never = Prior(lambda _: -np.inf, np.ones(4))
    assert evidence(pose, w, xy, prior=never) == -np.inf
    assert evidence(pose, w, xy, prior=anywhere(2000.0 * 1.05)) == -np.inf
    nominal, off = (evidence(pose, w, xy, prior=anywhere(f)) for f in (2000.0, 2000.0 * 1.02))
    assert off < nominal < off + 4


def test_more_evidence_than_the_prior_leaves_room_for_is_not_claimed(rng):
    """Two stars leave the roll and the focal length open: the prior's width is what counts, not theirs."""
    pose, w, xy = scene(rng, 2)
    close = 1e-3 * (xy - xy[0]) + xy[0]
    assert np.isfinite(evidence(pose, w, close)) and evidence(pose, w, close) < np.log(1e9)


def test_four_stars_are_mostly_enough_and_with_a_false_one_often(catalogue):
    """Fields of the paper's camera with four stars, one in a thousand: 0.3 mag of scatter, a star in 20 missing."""
    camera = Camera.from_focal(5616, 3744, 93750.0)
    conditions = Conditions(camera)
    sky = sky_for(catalogue, camera)
    for false, fewest in ((0, 6), (1, 5)):
        right = 0
        for number in FOUR_STARS:
            drawn = draw(catalogue, conditions, 3, number)
            assert len(drawn) == 4
            xy = drawn.with_false(false, camera).xy
            if found := identify(xy, np.full(len(xy), 0.05), camera, sky):
                centre = camera.directions(*camera.centre_px) @ found.attitude
                assert np.linalg.norm(centre - drawn.centre) < conditions.tolerance_rad
                right += 1
        assert right >= fewest

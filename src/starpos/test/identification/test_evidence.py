# SPDX-License-Identifier: Apache-2.0
"""The evidence for an identification: no larger by chance than it says, and as large as the stars allow."""

from types import SimpleNamespace

import numpy as np
import pytest
from crowds import identified
from scipy.optimize import least_squares
from test_identification import seen, sky_for

from starpos import rotation
from starpos.identification import PlumbPrior, PointingPrior, search
from starpos.identification import evidence as full
from starpos.identification._poses import log_ratio
from starpos.identification.evidence import CHANCES, DOUBLE_PX, LOG_SHARES, WIDTH, Prior, anywhere
from starpos.identification.pose import Pose, directions, stars_at
from starpos.instrument.camera import Camera
from starpos.simulation.montecarlo_fields import Conditions, draw
from starpos_testing.skies.scenes import random_attitude

# so few pixels that chance has a chance
SMALL = Camera.from_focal(300, 225, 375 / 2 / np.tan(np.radians(5.5)))
AREA_PX2 = 300.0 * 225
SIGMA_PX = 0.05
FOUR_STARS = 3360, 4849, 5625, 7250, 7450, 10342, 11075, 11546


def largest(fields, rng, catalogue, priors=tuple):
    """The largest evidence of all tries in each of a number of fields of random points."""
    sky, best = sky_for(catalogue, SMALL), []
    for _ in range(fields):
        n = int(rng.integers(5, 10))
        field = stars_at(SMALL, rng.uniform(0, [299, 224], (n, 2)), np.full(n, SIGMA_PX))
        tried = search.identifications(field, sky, priors(), enough=-np.inf)
        best.append(max((found.log_odds for found in tried), default=-np.inf))
    return np.array(best)


@pytest.mark.montecarlo
def test_over_random_points_it_rises_no_further_than_chance_allows(catalogue, rng):
    """Ville: a likelihood ratio exceeds x at most once in x, all hypotheses of a frame taken together."""
    best = largest(80, rng, catalogue)
    for x in (1, 2, 3, 4):
        allowed = np.exp(-x)
        assert np.mean(best > x) < allowed + 3 * np.sqrt(allowed / len(best))
    # Otherwise the test would not see anything.
    assert np.mean(best > -8) > 0.05


@pytest.mark.montecarlo
def test_a_prior_raises_it_no_further(catalogue, rng):
    def priors():
        return PointingPrior(random_attitude(rng), SMALL.fx), PlumbPrior(
            random_attitude(rng)[2], np.eye(3)[2], 4e-4
        )

    best = largest(60, rng, catalogue, priors)
    for x in (1, 2, 3, 4):
        allowed = np.exp(-x)
        assert np.mean(best > x) < allowed + 3 * np.sqrt(allowed / len(best))


def scene(rng, stars=12):
    """The pose fitted to stars on a frame, their directions (N, 3), brightest first, and where they are seen."""
    made = Pose(random_attitude(rng), 2000.0, False)
    xy = rng.uniform([-150, -112], [150, 112], (stars, 2))
    w = directions(xy[None], np.array([made.focal_px]))[0] @ made.attitude
    xy = xy + rng.normal(0, SIGMA_PX, xy.shape)

    def turned(step):
        return Pose(rotation.from_vector(step[:3]) @ made.attitude, 2000.0 * np.exp(step[3]), False)

    best = least_squares(lambda step: (turned(step).project(w) - xy).ravel(), np.zeros(4), x_scale=1e-4).x
    return turned(best), w, xy


def evidence(pose, w, xy, star=None, rank=None, prior=None):
    star = np.arange(len(w)) if star is None else star
    rank = np.arange(len(w)) if rank is None else rank
    sigma = np.full(len(xy), SIGMA_PX)
    prior = prior or anywhere(2000.0)
    ratio = log_ratio(xy, sigma, AREA_PX2, pose.attitude, pose.focal_px, prior.width, star, rank, w, CHANCES)
    return ratio + prior.log_density(pose)


def slopes(pose, w):
    """Derivatives (2 N, 4) of pixels by small rotations (rad) about C's axes and by the focal length's logarithm."""

    def pixels(turn, scale):
        turned = rotation.from_vector(turn) @ pose.attitude
        return Pose(turned, pose.focal_px * np.exp(scale), False).project(w)

    step = 1e-6 * np.eye(4)
    return np.stack([(pixels(d[:3], d[3]) - pixels(-d[:3], -d[3])).ravel() / 2e-6 for d in step], 1)


def test_it_is_the_integral_over_the_poses(rng):
    """Against the same integral by importance sampling, of five stars in order, none false."""
    pose, w, xy = scene(rng, 5)
    n = np.arange(5)
    false, right = 1 / (n + 3), (n + 2) / (n + 3) / 2
    slope = slopes(pose, w) / SIGMA_PX
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
    # One brighter than six stars was not seen.
    assert all_seen - one_missed == pytest.approx(6 * np.log(3))


def test_a_false_star_costs_and_a_crowd_of_them_costs_little_more(rng):
    pose, w, xy = scene(rng)
    worth = []
    for false in (0, 1, 5, 10):
        seen = np.concatenate([rng.uniform([-150, -112], [150, 112], (false, 2)), xy])
        worth.append(evidence(pose, w, seen, star=false + np.arange(len(w))))
    costs = -np.diff(worth)
    assert (costs > 0.5).all() and sum(costs) < 15


def test_a_detection_upon_another_says_nothing(rng):
    """Neither as a false star nor as the neighbour that the catalogue has there."""
    pose, w, xy = scene(rng, 6)
    beside = xy[0] + DOUBLE_PX * np.array([0.6, 0.0])
    alone, seen = evidence(pose, w, xy), np.insert(xy, 1, beside, 0)
    assert alone - 3 < evidence(pose, w, seen, star=np.r_[0, 2:7]) < alone
    neighbour = directions(beside[None, None], np.array([pose.focal_px]))[0] @ pose.attitude
    assert alone - 3 < evidence(pose, np.insert(w, 1, neighbour, 0), seen) < alone + 3


def test_the_priors_share_half_of_the_probability(catalogue, rng, monkeypatch):
    sky, attitude = sky_for(catalogue, SMALL), random_attitude(rng)
    field = stars_at(SMALL, rng.uniform(0, [299, 224], (20, 2)), np.full(20, SIGMA_PX))
    priors = PointingPrior(attitude, SMALL.fx), PlumbPrior(attitude[2], np.eye(3)[2], 1e-3)
    expected = Pose(attitude, SMALL.fx, False)
    tried = {}

    def judge(*known):
        tried[id(known[3])] = known[3]
        return finder.judge(*known)

    def anywhere(focal_px, log_share):
        prior = lost(focal_px, log_share)
        tried[id(prior)] = prior
        return prior

    finder, lost = full.finder_of(sky.catalogue, sky.triangles), search.anywhere
    monkeypatch.setattr(full, "finder_of", lambda *_: SimpleNamespace(judge=judge))
    monkeypatch.setattr(search, "anywhere", anywhere)
    assert not list(search.near_or_lost(field, sky, priors, search.STAGES))
    *led, unled = (np.exp(prior.log_density(expected)) * prior.width.prod() for prior in tried.values())
    assert sorted(led) == pytest.approx([1 / 8, 1 / 8, 1 / 4])
    assert unled < 1 / 2


def test_a_pose_that_the_prior_excludes_is_worth_nothing(rng):
    pose, w, xy = scene(rng)
    never = Prior(lambda _: -np.inf, np.ones(4))
    assert evidence(pose, w, xy, prior=never) == -np.inf
    assert evidence(pose, w, xy, prior=anywhere(2000.0 * 1.05)) == -np.inf
    nominal, off = (evidence(pose, w, xy, prior=anywhere(f)) for f in (2000.0, 2000.0 * 1.02))
    assert off < nominal < off + 4


def integral(prior, made, zenith, reach_rad, rng):
    """Integral of a prior over the poses whose zenith (3,) is within reach_rad of where `made` has it, in any roll."""
    total, poses = 0.0, 6000
    across = np.cross(zenith, made.attitude[np.argmin(np.abs(made.attitude @ zenith))])
    across /= np.linalg.norm(across)
    for k, (height, azimuth, roll) in enumerate(rng.random((poses, 3))):
        off = 2 * np.arcsin(np.sqrt(height) * np.sin(reach_rad / 2))
        tip = rotation.from_vector(off * rotation.from_vector(2 * np.pi * azimuth * zenith) @ across)
        attitude = made.attitude @ tip @ rotation.from_vector(2 * np.pi * roll * zenith)
        total += np.exp(
            prior.log_density(Pose(attitude, made.focal_px * np.exp(0.2 * (k + 0.5) / poses - 0.1), False))
        )
    return total / poses * 4 * np.pi * np.sin(reach_rad / 2) ** 2 * 2 * np.pi * 0.2


def test_a_prior_is_a_probability(rng):
    """Integrated over all poses, each density gives its share; the widths leave room for no more."""
    field = stars_at(SMALL, np.zeros((0, 2)), np.zeros(0))
    made = Pose(random_attitude(rng), SMALL.fx, False)
    zenith = random_attitude(rng)[2]
    plumb = PlumbPrior(zenith, made.attitude @ zenith, 0.01)._known(field, 0.0)
    pointing = PointingPrior(made.attitude, SMALL.fx)._known(field, 300.0, 0.0)
    lost = anywhere(SMALL.fx)
    assert integral(plumb, made, zenith, 0.03, rng) == pytest.approx(1, abs=0.15)
    assert integral(lost, made, zenith, np.pi, rng) == pytest.approx(0.9, abs=0.05)
    box = 1.5 * pointing.width
    inside = [
        pointing.log_density(
            Pose(rotation.from_vector(d[:3]) @ made.attitude, SMALL.fx * np.exp(d[3]), False)
        )
        for d in (rng.random((4000, 4)) - 0.5) * box
    ]
    assert np.mean(np.exp(inside)) * box.prod() == pytest.approx(1, abs=0.15)
    for prior in (plumb, pointing, lost):
        assert np.exp(prior.log_density(made)) * prior.width.prod() <= 1.1


def test_errors_of_nothing_are_no_certainty(catalogue, rng):
    sky = sky_for(catalogue, SMALL)
    for sigma_px in (0.0, 1e-200):
        for _ in range(5):
            assert identified(rng.uniform(0, [299, 224], (20, 2)), np.full(20, sigma_px), SMALL, sky) is None
        xy, _ = seen(sky, SMALL, random_attitude(rng), 8.0, rng, sigma=0.02)
        assert identified(xy, np.full(len(xy), sigma_px), SMALL, sky) is not None


def test_what_is_no_number_is_not_accepted(catalogue, rng, monkeypatch):
    sky = sky_for(catalogue, SMALL)
    xy, _ = seen(sky, SMALL, random_attitude(rng), 8.0, rng, sigma=0.02)
    sigma_px = np.full(len(xy), 0.02)
    assert identified(xy, sigma_px, SMALL, sky) is not None
    monkeypatch.setattr(search, "anywhere", lambda *_: Prior(lambda pose: np.nan, WIDTH))
    assert identified(xy, sigma_px, SMALL, sky) is None


def test_what_lies_beyond_the_frame_does_not_make_chance_rarer(rng):
    xy = rng.uniform(0, [299, 224], (20, 2))
    # As a lens that draws in does.
    xy[3] = -40.0, 100.0
    field = stars_at(SMALL, SMALL.directions(*xy.T), np.full(20, SIGMA_PX))
    assert (field.half > [150, 112.5]).all()
    assert field.area_px2 == AREA_PX2


def test_more_evidence_than_the_prior_leaves_room_for_is_not_claimed(rng):
    """Two stars leave the roll and the focal length open: the prior's width is what counts, not theirs."""
    pose, w, xy = scene(rng, 2)
    close = 1e-3 * (xy - xy[0]) + xy[0]
    assert np.isfinite(evidence(pose, w, close)) and evidence(pose, w, close) < np.log(1e9)


def test_four_stars_are_mostly_enough_and_with_a_false_one_often(catalogue):
    """Fields of the paper's camera with four stars, one in a thousand: 0.3 mag of scatter, a star in 20 missing."""
    camera = Camera.from_focal(5616, 3744, 93750.0)
    conditions = Conditions(camera=camera)
    sky = sky_for(catalogue, camera)
    for false, fewest in ((0, 6), (1, 5)):
        right = 0
        for number in FOUR_STARS:
            drawn = draw(catalogue, conditions, 3, number)
            assert len(drawn) == 4
            xy = drawn.with_false(false, camera).xy
            if found := identified(xy, np.full(len(xy), 0.05), camera, sky):
                centre = camera.directions(*camera.centre_px) @ found.attitude
                assert np.linalg.norm(centre - drawn.centre) < conditions.tolerance_rad
                right += 1
        assert right >= fewest

# SPDX-License-Identifier: Apache-2.0
"""Lost in space: simulated fields whose stars and pointing are known."""

from dataclasses import replace

import numpy as np
import pytest
from crowds import identified

from starpos.errors import InstrumentError
from starpos.identification import Sky, field_of, identify, search, triangles
from starpos.instrument.camera import Camera
from starpos_testing.skies.scenes import FOCAL_PX, SIZE, random_attitude, random_stars

FIELDS = {
    "15 deg": (Camera.from_focal(*SIZE, FOCAL_PX), 7.0),
    # The paper's field, pixels binned by four.
    "4 deg": (Camera.from_focal(1404, 936, 23437.5), 9.5),
}


def sky_for(catalogue, camera, **more):
    return Sky(catalogue, triangles.cached_triangles(catalogue, camera.half_diagonal_rad), **more)


def seen(sky, camera, attitude, limit_mag, rng, sigma=0.05, missing=0.0):
    """Pixels (N, 2), brightest first, and catalogue indices of the stars on a frame."""
    index = sky.catalogue.cone(attitude[2], camera.half_diagonal_rad * 1.05, limit_mag)
    xy = camera.project(sky.directions(index) @ attitude.T)
    on = (
        (xy >= 0).all(1)
        & (xy <= [camera.width - 1, camera.height - 1]).all(1)
        & (rng.random(len(xy)) >= missing)
    )
    return xy[on] + rng.normal(0, sigma, (on.sum(), 2)), index[on]


def check(found, attitude, index, camera, sky, tolerance_px=0.3):
    """The boresight is right, and each matched star is the one it was made from, or its neighbour within a pixel."""
    assert found is not None
    apart = np.arccos(np.clip(found.attitude[2] @ attitude[2], -1, 1))
    assert apart < tolerance_px / camera.fx
    truth = index[found.star]
    assert truth.min() >= 0
    beside = np.linalg.norm(sky.directions(truth) - sky.directions(found.catalogue), axis=1)
    assert beside.max() < 1 / camera.fx


@pytest.mark.parametrize("size", FIELDS)
@pytest.mark.parametrize("false_stars", [0, 1, 2])
def test_fields_are_found_with_false_stars_brighter_than_all_others(size, false_stars, catalogue, rng):
    camera, limit = FIELDS[size]
    sky = sky_for(catalogue, camera)
    found = 0
    for _ in range(10):
        attitude = random_attitude(rng)
        xy, index = seen(sky, camera, attitude, limit, rng)
        xy = np.concatenate([rng.uniform(0, [camera.width - 1, camera.height - 1], (false_stars, 2)), xy])
        index = np.concatenate([np.full(false_stars, -1), index])
        answer = identified(xy, np.full(len(xy), 0.05), camera, sky)
        if answer is not None:
            found += 1
            check(answer, attitude, index, camera, sky)
            assert answer.focal_scale == pytest.approx(1, abs=1e-3)
            assert answer.residual_px == pytest.approx(0.05, abs=0.03)
            assert not answer.mirrored
    assert found >= 9


def test_stars_missing_from_the_frame(catalogue, rng):
    camera, limit = FIELDS["15 deg"]
    sky = sky_for(catalogue, camera)
    for _ in range(6):
        attitude = random_attitude(rng)
        xy, index = seen(sky, camera, attitude, limit, rng, sigma=0.2, missing=0.1)
        check(identified(xy, np.full(len(xy), 0.2), camera, sky), attitude, index, camera, sky)


@pytest.mark.parametrize("factor", [0.97, 1.03])
def test_a_focal_length_three_percent_off(factor, catalogue, rng):
    camera, limit = FIELDS["15 deg"]
    sky = sky_for(catalogue, camera)
    for _ in range(4):
        attitude = random_attitude(rng)
        xy, index = seen(sky, camera.scaled(factor), attitude, limit, rng)
        answer = identified(xy, np.full(len(xy), 0.05), camera, sky)
        check(answer, attitude, index, camera, sky)
        assert answer.focal_scale == pytest.approx(factor, rel=1e-3)


@pytest.mark.parametrize("corner_px", [-15.0, -6.0, 6.0, 15.0])
def test_a_lens_whose_distortion_nobody_knows(corner_px, catalogue, rng):
    camera, limit = FIELDS["15 deg"]
    sky, found = sky_for(catalogue, camera), 0
    half = np.array([camera.width, camera.height]) / 2
    for _ in range(5):
        attitude = random_attitude(rng)
        xy, index = seen(sky, camera, attitude, limit, rng)
        off = xy - camera.centre_px
        r2 = np.sum(off**2, 1, keepdims=True) / np.sum(half**2)
        distorted = camera.centre_px + off * (1 + corner_px * r2 / np.hypot(*half))
        answer = identified(distorted, np.full(len(xy), 0.05), camera, sky)
        if answer is not None:
            found += 1
            check(answer, attitude, index, camera, sky, tolerance_px=2.0)
    assert found == 5


def test_a_focal_length_a_third_off_is_not_found(catalogue, rng):
    camera, limit = FIELDS["15 deg"]
    sky = sky_for(catalogue, camera)
    for _ in range(2):
        xy, _ = seen(sky, camera.scaled(1.33), random_attitude(rng), limit, rng)
        assert identified(xy, np.full(len(xy), 0.05), camera, sky) is None


def test_a_mirrored_frame_is_found_and_said(catalogue, rng):
    camera, limit = FIELDS["15 deg"]
    sky = sky_for(catalogue, camera)
    attitude = random_attitude(rng)
    xy, index = seen(sky, camera, attitude, limit, rng)
    answer = identified(xy * [1, -1] + [0, camera.height - 1], np.full(len(xy), 0.05), camera, sky)
    assert answer.mirrored
    check(answer, attitude, index, camera, sky)


def test_random_points_are_nothing(catalogue, rng):
    camera, _ = FIELDS["15 deg"]
    sky = sky_for(catalogue, camera)
    for n in (4, 6, 12, 30, 200):
        for _ in range(2):
            s = random_stars(n, rng)
            assert identified(np.stack([s.x, s.y], 1), np.full(n, 0.05), camera, sky) is None


def test_a_star_seen_double_does_not_speak_for_itself(catalogue, rng):
    """Every point twice: any triangle has three twins that agree with it."""
    camera, _ = FIELDS["15 deg"]
    for apart_px in (0.0, 0.1, 0.7):
        for _ in range(8):
            xy = np.repeat(rng.uniform(0, [999, 699], (12, 2)), 2, 0)
            xy += rng.normal(0, apart_px, xy.shape)
            assert identified(xy, np.full(24, 0.05), camera, sky_for(catalogue, camera)) is None


def test_brightness_out_of_order_by_more_than_expected(catalogue, rng):
    camera, limit = FIELDS["4 deg"]
    sky, found = sky_for(catalogue, camera), 0
    for _ in range(10):
        attitude = random_attitude(rng)
        xy, index = seen(sky, camera, attitude, limit, rng)
        order = np.argsort(np.arange(len(xy)) + rng.exponential(4.0, len(xy)) * (rng.random(len(xy)) < 0.3))
        answer = identified(xy[order], np.full(len(xy), 0.05), camera, sky)
        if answer is not None:
            found += 1
            check(answer, attitude, index[order], camera, sky)
    assert found >= 9


@pytest.mark.parametrize("n", [0, 1, 2, 3])
def test_too_few(n, catalogue, rng):
    camera, _ = FIELDS["15 deg"]
    assert (
        identified(rng.uniform(0, 600, (n, 2)), np.full(n, 0.05), camera, sky_for(catalogue, camera)) is None
    )


def test_aberration_of_the_date(catalogue, rng):
    """20.5 arcsec of annual aberration, given to Sky, is not left in the boresight."""
    camera, limit = FIELDS["15 deg"]
    sky = sky_for(catalogue, camera, year=2026.8, velocity=(6e-5, -7e-5, -3e-5))
    attitude = random_attitude(rng)
    xy, index = seen(sky, camera, attitude, limit, rng)
    check(identified(xy, np.full(len(xy), 0.05), camera, sky), attitude, index, camera, sky)
    # to first order in the velocity, across the direction
    straight, velocity = sky.catalogue.directions(np.array([5]), 2026.8)[0], np.array(sky.velocity)
    moved = sky.directions(np.array([5]))[0] - straight
    np.testing.assert_allclose(moved, velocity - (velocity @ straight) * straight, atol=1e-8)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_what_is_no_number_is_refused(value, catalogue, rng):
    camera, _ = FIELDS["15 deg"]
    sky, xy, sigma = sky_for(catalogue, camera), rng.uniform(0, 600, (12, 2)), np.full(12, 0.05)
    for broken in (xy, sigma):
        kept, broken[3] = broken[3].copy(), value
        with pytest.raises(ValueError, match="finite"):
            identified(xy, sigma, camera, sky)
        broken[3] = kept
    v = camera.directions(*xy.T)
    v[3] = value
    with pytest.raises(ValueError, match="finite"), np.errstate(invalid="ignore"):
        identify(field_of(v, sigma, camera), sky)


DEGENERATE = {
    "one place": lambda rng: np.full((30, 2), 300.0),
    "a row": lambda rng: np.stack([np.arange(30) * 20.0, np.full(30, 300.0)], 1),
    "a grid": lambda rng: np.stack(np.meshgrid(np.arange(6) * 100.0, np.arange(6) * 100.0), -1).reshape(
        -1, 2
    ),
    "pairs": lambda rng: np.repeat(rng.uniform(0, 600, (15, 2)), 2, 0),
    "a corner": lambda rng: rng.uniform(0, 1e-6, (20, 2)),
    "outside": lambda rng: rng.uniform(1e5, 2e5, (20, 2)),
}


@pytest.mark.parametrize("kind", DEGENERATE)
def test_degenerate_lists_raise_nothing(kind, catalogue, rng):
    camera, _ = FIELDS["15 deg"]
    xy = DEGENERATE[kind](rng)
    answer = identified(xy, np.full(len(xy), 0.05), camera, sky_for(catalogue, camera))
    assert answer is None


def test_coarse_centroids_are_searched_with_their_own_error(catalogue, rng):
    camera, limit = FIELDS["15 deg"]
    sky = sky_for(catalogue, camera)
    error_px = 4.0
    found = 0
    for _ in range(8):
        attitude = random_attitude(rng)
        xy, _ = seen(sky, camera, attitude, limit, rng, sigma=error_px)
        tight = [stage for stage in search.STAGES if stage[1] < 1.0]
        # The loose stages, made for lenses that distort, would help out.
        with pytest.MonkeyPatch.context() as only:
            only.setattr(search, "STAGES", tight)
            answer = identified(xy, np.full(len(xy), error_px), camera, sky)
        if answer is not None:
            assert np.arccos(np.clip(answer.attitude[2] @ attitude[2], -1, 1)) < 2 / camera.fx
            found += 1
    assert found >= 7


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize(
    "window", [(0, 0, 500, 700), (500, 0, 1000, 700), (0, 0, 1000, 300), (0, 350, 1000, 700)]
)
def test_stars_of_a_hidden_part_are_not_missed(window, mirrored, catalogue, rng):
    camera, limit = FIELDS["15 deg"]
    sky = sky_for(catalogue, camera)
    attitude = random_attitude(rng)
    xy, index = seen(sky, camera, attitude, limit, rng)
    if mirrored:
        xy[:, 1] = camera.height - 1 - xy[:, 1]
    shown = ((xy >= window[:2]) & (xy < window[2:])).all(1)
    v, sigma = camera.directions(*xy[shown].T), np.full(shown.sum(), 0.05)
    part = identify(field_of(v, sigma, camera, window), sky)
    whole = identify(field_of(v, sigma, camera), sky)
    check(part, attitude, index[shown], camera, sky)
    assert part.mirrored == mirrored
    # of the brightest stars that should be there, nearly all are
    of_part, of_whole = (np.isin(a.expected[: len(part.star)], part.catalogue).mean() for a in (part, whole))
    assert of_part > 0.75
    assert of_whole < of_part - 0.15
    assert part.log_odds > whole.log_odds + 3


def test_the_area_of_chance_is_that_of_the_window(catalogue, rng):
    camera, _ = FIELDS["15 deg"]
    v = camera.directions(*rng.uniform(100, 300, (2, 8)))
    field = search.field_of(v, np.full(8, 0.05), camera, (0, 0, camera.width // 4, camera.height))
    assert field.area_px2 == pytest.approx(camera.width // 4 * camera.height)
    assert 4 * field.half.prod() == pytest.approx(field.area_px2)


def test_a_window_whose_corners_the_lens_does_not_know_is_left_aside(catalogue, rng):
    ideal, _ = FIELDS["15 deg"]
    # a barrel distortion that folds at nine tenths of the way to a corner
    k1 = -((2 / 3 / (0.9 * ideal.half_diagonal_rad)) ** 2) / 3
    camera = replace(ideal, distortion=(k1, 0.0, 0.0, 0.0, 0.0))
    window = 0, 0, camera.width // 2, camera.height
    with pytest.raises(InstrumentError):
        camera.directions([0.0], [0.0])
    middle = np.array([[camera.cx], [camera.cy]])
    v = camera.directions(*(middle + rng.uniform(-100, 100, (2, 8))))
    field = search.field_of(v, np.full(8, 0.05), camera, window)
    assert field.area_px2 == camera.width * camera.height

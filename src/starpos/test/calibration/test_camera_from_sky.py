# SPDX-License-Identifier: Apache-2.0
"""From star lists to a camera: simulated skies through lenses of all kinds, frames of nothing, and real frames."""

import csv
from dataclasses import replace

import numpy as np
import pytest

from starpos import rotation
from starpos.calibration.camera import calibrate_camera, lens_of_frame, rms
from starpos.detection import detect
from starpos.earth.refraction import Atmosphere
from starpos.errors import CalibrationError, InstrumentError
from starpos.fix.solver import Solver
from starpos.frames.frame import SATURATED, Stars, no_stars
from starpos.frames.reading import read_frame
from starpos.instrument.camera import Camera
from starpos.instrument.instrument import Instrument
from starpos_testing.skies.lenses import (
    AIR,
    FIELDS,
    ideal,
    k1_of,
    night,
    prediction_errors,
    random_camera,
    values,
)
from starpos_testing.skies.scenes import random_stars, with_false_stars


def flipped(stars: Stars) -> Stars:
    return replace(stars, y=stars.height - 1 - stars.y)


@pytest.fixture(scope="module")
def wide(catalogue):
    """A random camera of 25 deg, four frames of it, their levels."""
    rng = np.random.default_rng(25)
    true = random_camera(25, rng)
    return true, *night(true, 4, catalogue, rng, FIELDS[25][2])


@pytest.mark.parametrize("field", FIELDS)
def test_from_an_ideal_camera_to_the_true_one(field, catalogue, rng):
    true = random_camera(field, rng)
    lists, levels = night(true, 8, catalogue, rng, FIELDS[field][2])
    found = calibrate_camera(lists, levels, ideal(field), catalogue, AIR)
    fit = found.fit
    assert found.used == tuple(range(8))
    assert np.abs((fit.values - values(true)) / fit.sigma).max() < 4
    errors = prediction_errors(true, fit.camera)
    assert rms(errors) < 0.02
    assert np.abs(errors).max() < max(0.04, 4 * fit.worst_sigma_px)
    assert fit.rms_px < 0.35 * rms(fit.before)
    # To the faint and the corners.
    assert len(fit.xy) > 0.97 * sum(map(len, lists))


@pytest.mark.parametrize("corner", [-0.06, -0.02, 0.02, 0.06])
def test_lenses_that_shift_the_corner_by_many_px(corner, catalogue, rng):
    given = ideal(25)
    true = replace(given, distortion=(k1_of(given, corner), 0.0, 1e-3, -1e-3, 0.0))
    lists, levels = night(true, 4, catalogue, rng, FIELDS[25][2])
    fit = calibrate_camera(lists, levels, given, catalogue, AIR).fit
    assert np.abs((fit.values - values(true)) / fit.sigma).max() < 4
    assert len(fit.xy) > 0.96 * sum(map(len, lists))
    reach = np.hypot(*(fit.xy - np.array(given.centre_px)).T).max()
    assert reach > 0.95 * np.hypot(*given.centre_px)


def test_low_over_the_horizon_where_refraction_bends_the_field(catalogue, rng):
    true = random_camera(3.4, rng)
    lists, levels = night(true, 4, catalogue, rng, FIELDS[3.4][2], altitude=(12, 16))
    fit = calibrate_camera(lists, levels, ideal(3.4), catalogue, AIR).fit
    assert np.abs((fit.values - values(true)) / fit.sigma).max() < 4
    assert len(fit.xy) > 0.95 * sum(map(len, lists))


def test_wide_lenses_from_one_frame_of_few_stars_are_true_or_refused(catalogue, rng):
    """As many stars as are just enough, 6 % of distortion: wrong matches in the corners must not pass for a lens."""
    solved = 0
    for corner in np.repeat([-0.06, 0.06], 12):
        true = replace(random_camera(25, rng), distortion=(k1_of(ideal(25), corner), 0.0, 0.0, 0.0, 0.0))
        lists, levels = night(true, 1, catalogue, rng, 5.9)
        try:
            fit = calibrate_camera(lists, levels, ideal(25), catalogue, AIR).fit
        except CalibrationError:
            continue
        solved += 1
        assert np.abs((fit.values - values(true)) / fit.sigma).max() < 5
        assert np.abs(prediction_errors(true, fit.camera)).max() < 6 * fit.worst_sigma_px
    assert solved > 3


def test_the_lens_that_one_frames_stars_show_is_nearer_than_a_pinhole(catalogue, rng):
    given, nearer = ideal(25), 0
    solver = Solver(Instrument(given.fx), catalogue)
    for corner in np.repeat([0.0, -0.03, 0.03], 4):
        true = replace(given, distortion=(k1_of(given, corner), 0.0, 0.0, 0.0, 0.0))
        (stars,), _ = night(true, 1, catalogue, rng, 6.3)
        found = solver.identify(stars).found
        if found is None:
            continue
        lens, _ = lens_of_frame(stars, found, given, catalogue, AIR)
        off, before = (np.abs(prediction_errors(true, camera)).max() for camera in (lens, given))
        assert off < max(before / 5, 0.2)
        nearer += corner != 0
    assert nearer > 3


def test_what_one_frames_stars_leave_open_of_the_lens_turns_it_as_claimed(catalogue, rng):
    """Decentred lenses, which a frame hardly shows; without those terms the claim would be ten times too small."""
    given, sigmas = ideal(25), []
    solver = Solver(Instrument(given.fx), catalogue)
    corner = np.hypot(given.width, given.height) / 2 / given.fx
    for _ in range(12):
        p1, p2 = rng.normal(0, 0.003 / (3 * corner), 2)
        true = replace(given, distortion=(k1_of(given, 0.02), 0.0, p1, p2, 0.0))
        (stars,), _ = night(true, 1, catalogue, rng, 6.3)
        if (found := solver.identify(stars).found) is not None:
            lens, left_rad = lens_of_frame(stars, found, given, catalogue, AIR)
            seen, right = (camera.directions(stars.x, stars.y) for camera in (lens, true))
            turn = rotation.to_small_vector(rotation.best_rotation(seen, right))
            sigmas.extend(turn[:2] / left_rad)
    assert len(sigmas) > 12 and 0.4 < np.sqrt(np.mean(np.square(sigmas))) < 1.6


def test_images_that_are_unsound_are_left_out_where_there_are_others(wide, catalogue, rng):
    true, lists, levels = wide
    spoiled = []
    for stars in lists:
        bad = rng.random(len(stars)) < 0.3
        spoiled.append(replace(stars, x=stars.x + 0.15 * bad, flags=np.where(bad, SATURATED, stars.flags)))
    fit = calibrate_camera(spoiled, levels, ideal(25), catalogue, AIR).fit
    assert np.abs((fit.values - values(true)) / fit.sigma).max() < 4
    assert fit.scatter_px < 0.03
    assert len(fit.xy) < 0.8 * sum(map(len, lists))


def test_a_focal_length_three_percent_off(wide, catalogue):
    true, lists, levels = wide
    fit = calibrate_camera(
        lists, levels, ideal(25).scaled(true.fx / ideal(25).fx * 1.028), catalogue, AIR
    ).fit
    assert np.abs((fit.values - values(true)) / fit.sigma).max() < 4


def test_false_stars_brighter_than_all_others(wide, catalogue, rng):
    true, lists, levels = wide
    spoiled = [with_false_stars(s, rng.uniform(0, [999, 699], (3, 2))) for s in lists]
    fit = calibrate_camera(spoiled, levels, ideal(25), catalogue, AIR).fit
    assert np.abs((fit.values - values(true)) / fit.sigma).max() < 4


def test_frames_of_nothing_and_of_noise_are_left_out(wide, catalogue, rng):
    true, lists, levels = wide
    more = [lists[0], no_stars(1000, 700, source="cap on"), lists[1], random_stars(60, rng), lists[2]]
    found = calibrate_camera(
        more, [levels[0], levels[0], levels[1], None, levels[2]], ideal(25), catalogue, AIR
    )
    assert found.used == (0, 2, 4)
    assert len(found.fit.attitudes) == 3
    assert np.abs((found.fit.values - values(true)) / found.fit.sigma).max() < 4


def test_one_frame_is_enough(wide, catalogue):
    true, lists, levels = wide
    fit = calibrate_camera(lists[:1], levels[:1], ideal(25), catalogue, AIR).fit
    assert np.abs((fit.values - values(true)) / fit.sigma).max() < 4
    assert np.abs(prediction_errors(true, fit.camera)).max() < 4 * fit.worst_sigma_px


def test_without_levels_the_sigma_covers_the_refraction(catalogue, rng):
    true = random_camera(11, rng)
    lists, levels = night(true, 5, catalogue, rng, FIELDS[11][2], altitude=(50, 60))
    known = calibrate_camera(lists, levels, ideal(11), catalogue, AIR).fit
    unknown = calibrate_camera(lists, [None] * 5, ideal(11), catalogue, AIR).fit
    assert np.abs((unknown.values - values(true)) / unknown.sigma)[:2].max() < 4
    assert (unknown.sigma > 3 * known.sigma)[:2].all()
    untimed = [replace(s, mid_unix_s=None, exposure_s=None) for s in lists]
    fit = calibrate_camera(untimed, [None] * 5, ideal(11), catalogue, AIR).fit
    assert np.abs((fit.values - values(true)) / fit.sigma)[:2].max() < 4
    assert (fit.sigma > 1.1 * unknown.sigma)[:2].all()


def test_nothing_identified_is_said(catalogue, rng):
    with pytest.raises(CalibrationError, match="no part of the sky matches any of the 2 frames"):
        calibrate_camera(
            [random_stars(40, rng), no_stars(1000, 700)], [None, None], ideal(25), catalogue, AIR
        )


def test_too_few_stars_are_said(wide, catalogue):
    _, lists, levels = wide
    with pytest.raises(CalibrationError, match="are too few"):
        calibrate_camera([lists[0].select(np.arange(15))], levels[:1], ideal(25), catalogue, AIR)


def test_frames_of_another_size(wide, catalogue):
    _, lists, levels = wide
    other = replace(lists[1], width=1001, source="b.fits")
    with pytest.raises(CalibrationError, match=r"b\.fits: the frame is 1001 x 700 px but .* 1000 x 700"):
        calibrate_camera([lists[0], other], levels[:2], ideal(25), catalogue, AIR)


def test_a_mirrored_frame(wide, catalogue):
    _, lists, _ = wide
    with pytest.raises(InstrumentError, match="frame 1: the frame is mirrored"):
        calibrate_camera([lists[0], flipped(lists[1])], [None, None], ideal(25), catalogue, AIR)


def test_frames_of_two_cameras_are_not_averaged(wide, catalogue, rng):
    true, lists, _ = wide
    other = replace(true.scaled(1.02), cx=true.cx + 30)
    others, _ = night(other, 4, catalogue, rng, FIELDS[25][2])
    with pytest.raises(CalibrationError):
        calibrate_camera([*lists, *others], [None] * 8, ideal(25), catalogue, AIR)


def test_real_frames_of_one_camera_lie_closer_and_claim_what_halves_of_them_show(shared, catalogue):
    with (shared / "real" / "truth.csv").open() as f:
        rows = [row for row in csv.DictReader(f) if row["set"] == "tetra3"]
    lists = [detect(read_frame(shared / "real" / "tetra3" / row["file"])).stars for row in rows]
    scale = np.mean([float(row["scale_x"]) for row in rows])
    given = Camera.from_focal(1024, 768, float(np.degrees(3600) / scale))
    air = Atmosphere.measured(None, None)
    found = calibrate_camera(lists, [None] * 8, given, catalogue, air)
    fit = found.fit
    assert found.used == tuple(range(8))
    assert fit.rms_px < 0.85 * rms(fit.before)
    assert fit.rejected < 0.02 * len(fit.xy)
    assert fit.camera.scale_arcsec == pytest.approx(scale, rel=2e-3)
    a, b = (calibrate_camera(lists[k::2], [None] * 4, given, catalogue, air).fit for k in (0, 1))
    assert (np.abs(a.values - b.values) < 4 * np.hypot(a.sigma, b.sigma)).all()
    assert rms(prediction_errors(a.camera, b.camera)) < 0.1

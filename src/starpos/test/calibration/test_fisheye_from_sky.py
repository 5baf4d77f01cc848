# SPDX-License-Identifier: Apache-2.0
"""Fisheyes from the sky: their coefficients within what is claimed, and a fix with the camera that was found."""

import math
from dataclasses import replace

import numpy as np
import pytest

from starpos.calibration.camera import calibrate_camera, fit_camera, hour_by_lens, rms
from starpos.calibration.camera_adjustment import parameters
from starpos.earth.place import Place
from starpos.errors import CalibrationError, PlaceError
from starpos.fix.searching import Question, answer_frame
from starpos.fix.solver import Solver
from starpos.instrument.camera import EQUIDISTANT, Camera
from starpos.instrument.instrument import Instrument
from starpos_testing.skies.lenses import AIR, VACUUM, night, sightings, values

IDEAL = Camera.from_focal(2000, 2000, 600.0, EQUIDISTANT)
# where the simulated nights are
SITE = Place.by_gravity(35.7046, 51.4106)
# of a lens that is nearly equisolid, one that is nearly stereographic, one whose picture ends at 100 deg
LENSES = {
    "equisolid": (-0.0417, 5e-4, 1e-5, -2e-6),
    "stereographic": (0.083, 0.0083, 8e-4, 1e-4),
    "short": (-0.1, -0.0015, 0.0, 0.0),
}


def random_fisheye(lens, rng):
    cx, cy = (np.array(IDEAL.centre_px) + rng.normal(0, 15, 2)).tolist()
    f = IDEAL.fx * (1 + rng.uniform(-0.015, 0.015))
    return replace(IDEAL, fx=f, fy=f * (1 + rng.normal(0, 1e-3)), cx=cx, cy=cy, distortion=lens)


def nights(true, catalogue, rng, frames=2):
    return night(true, frames, catalogue, rng, 5.5, altitude=(70, 90))


def picture_errors(true, fitted, most_deg=80):
    """Errors (N, 2) px of a fitted camera where stars are seen, after the best turn of its axis."""
    theta, around = np.meshgrid(np.radians(np.linspace(2, most_deg, 14)), np.linspace(0, 6, 20))
    v = np.stack([np.sin(theta) * np.cos(around), np.sin(theta) * np.sin(around), np.cos(theta)], -1).reshape(
        -1, 3
    )
    off = fitted.project(v) - true.project(v)
    turned = [(fitted.project(v + 1e-6 * np.cross(t, v)) - fitted.project(v)) / 1e-6 for t in np.eye(3)]
    design = np.stack(turned, -1).reshape(-1, 3)
    return (off.ravel() - design @ np.linalg.lstsq(design, off.ravel(), rcond=None)[0]).reshape(-1, 2)


@pytest.mark.parametrize("lens", LENSES)
def test_the_coefficients_are_found_within_what_is_claimed(lens, catalogue, rng):
    true = random_fisheye(LENSES[lens], rng)
    lists, levels = nights(true, catalogue, rng)
    # a known place serves as the level
    by_place = lens == "stereographic"
    known = {"levels": [None] * 2, "site": SITE} if by_place else {"levels": levels}
    found = calibrate_camera(lists, given=IDEAL, catalogue=catalogue, atmosphere=AIR, **known)
    fit = found.fit
    assert found.used == tuple(range(2)) and fit.camera.model == EQUIDISTANT
    assert np.abs((fit.values - values(true)) / fit.sigma).max() < 4
    assert fit.determined.all()
    assert rms(picture_errors(true, fit.camera)) < 0.03
    assert np.abs(picture_errors(true, fit.camera)).max() < max(0.05, 4 * fit.worst_sigma_px)
    assert fit.rms_px < 0.1


@pytest.mark.montecarlo
def test_over_many_fisheyes_the_errors_are_those_claimed(rng):
    z, given = [], Camera.from_focal(1300, 1300, 600.0, EQUIDISTANT)
    for _ in range(15):
        lens = (rng.uniform(-0.03, 0.08), *rng.normal(0, [2e-3, 1e-4, 1e-5]).tolist())
        cx, cy = (np.array(given.centre_px) + rng.normal(0, 15, 2)).tolist()
        true = replace(random_fisheye(lens, rng), width=1300, height=1300, cx=cx, cy=cy)
        fit = fit_camera(sightings(true, 6, 150, rng), given, VACUUM)
        z.append((fit.values - values(true)) / fit.sigma)
    z2 = np.square(z)
    assert 0.6 < z2.mean() < 1.5
    assert (z2.mean(0) < 2.2).all() and (z2.mean(0) > 0.3).all()


def test_a_wrong_hour_puts_stars_under_the_horizon(catalogue, rng):
    true = random_fisheye(LENSES["equisolid"], rng)
    (stars,), _ = nights(true, catalogue, rng, 1)
    late = replace(stars, mid_unix_s=stars.mid_unix_s + 6 * 3600)
    with pytest.raises(PlaceError, match=r"under the horizon.*not local time"):
        calibrate_camera([late], [None], IDEAL, catalogue, AIR, site=SITE)
    # of the ideal lens only the middle is identified, where no star has set
    solver = Solver(Instrument(IDEAL.fx, model=EQUIDISTANT), catalogue, AIR)
    answer = answer_frame(solver, Question(item=late, stars=late, places=SITE)).solution
    assert answer.at_place is None and "under the horizon" in answer.message
    sound = answer_frame(solver, Question(item=stars, stars=stars, places=SITE)).solution
    assert sound.at_place is not None


def test_a_decentred_lens_is_found_where_the_stars_show_it(catalogue, rng):
    true = random_fisheye((*LENSES["equisolid"], 4e-3, -3e-3), rng)
    lists, _ = nights(true, catalogue, rng, 2)
    found = calibrate_camera(lists, [None] * 2, IDEAL, catalogue, AIR, site=SITE)
    assert found.fit.camera.coefficients[-2:] == ("p1", "p2")
    assert np.abs((found.fit.values - values(true)) / found.fit.sigma).max() < 4
    assert rms(picture_errors(true, found.fit.camera)) < 0.03
    assert found.lean_rad < 4 * found.lean_sigma_rad


def test_refraction_shows_an_hour_that_no_star_under_the_horizon_does(catalogue, rng):
    true = random_fisheye(LENSES["equisolid"], rng)
    lists, _ = nights(true, catalogue, rng, 3)
    solver = Solver(Instrument(IDEAL.fx, camera=true), catalogue, AIR)
    up = answer_frame(solver, Question(item=lists[0], stars=lists[0], places=SITE)).solution
    assert up.at_place.hour_shown and not up.remark
    late = [replace(s, mid_unix_s=s.mid_unix_s + 2400) for s in lists]
    with pytest.raises(PlaceError, match=r"refraction shows the zenith|under the horizon"):
        calibrate_camera(late, [None] * 3, IDEAL, catalogue, AIR, site=SITE)
    answer = answer_frame(solver, Question(item=late[0], stars=late[0], places=SITE)).solution
    assert answer.at_place is None and "UTC" in answer.message


def test_a_frame_of_the_middle_of_the_sky_does_not_show_its_hour(catalogue, rng):
    true = random_fisheye(LENSES["equisolid"], rng)
    (stars,), _ = nights(true, catalogue, rng, 1)
    near = np.hypot(stars.x - true.cx, stars.y - true.cy) < 0.7 * true.fx
    solver = Solver(Instrument(IDEAL.fx, model=EQUIDISTANT), catalogue, AIR)
    middle = stars.select(near)
    answer = answer_frame(solver, Question(item=middle, stars=middle, places=SITE)).solution
    assert answer.at_place is not None and "its hour is right" in answer.remark
    assert answer.with_remark("first").remark == f"first; {answer.remark}"
    # with no error of the clock stated the hour may be wrong
    from_files = replace(solver, hour_by_lens=hour_by_lens)
    wide = answer_frame(from_files, Question(item=middle, stars=middle, places=SITE)).solution.at_place
    assert math.sqrt(wide.plumb.angles_covariance[0, 0]) > math.radians(5)
    stated = replace(from_files, instrument=replace(solver.instrument, clock_stddev_s=1.0))
    known = answer_frame(stated, Question(item=middle, stars=middle, places=SITE)).solution.at_place
    assert math.sqrt(known.plumb.angles_covariance[0, 0]) < math.radians(0.2)


def test_a_frame_of_an_unknown_lens_shows_its_hour_or_claims_to_miss_it(catalogue, rng):
    true = random_fisheye(LENSES["equisolid"], rng)
    (stars,), _ = nights(true, catalogue, rng, 1)
    solver = Solver(Instrument(IDEAL.fx, model=EQUIDISTANT), catalogue, AIR, hour_by_lens=hour_by_lens)
    right = answer_frame(solver, Question(item=stars, stars=stars, places=SITE)).solution
    assert right.at_place.hour_shown and not right.remark
    for late_s in (-3600, 3600):
        late = replace(stars, mid_unix_s=stars.mid_unix_s + late_s)
        wrong = answer_frame(solver, Question(item=late, stars=late, places=SITE)).solution.at_place
        if wrong is not None:
            off = math.remainder(wrong.plumb.heading - right.at_place.plumb.heading, 2 * math.pi)
            assert abs(off) < 3 * math.sqrt(wrong.plumb.angles_covariance[0, 0])


def test_without_tilts_refraction_would_pass_for_the_lens(catalogue, rng):
    true = random_fisheye(LENSES["equisolid"], rng)
    lists, _ = nights(true, catalogue, rng, 1)
    with pytest.raises(CalibrationError, match="--site, or the --tilt"):
        calibrate_camera(lists, [None], IDEAL, catalogue, AIR)


def test_names_of_the_parameters():
    assert parameters(IDEAL) == ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4")

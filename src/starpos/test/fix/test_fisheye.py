# SPDX-License-Identifier: Apache-2.0
"""Fisheyes of up to the whole sky: identified by their middle or, where that is covered, next to it; a true fix."""

from dataclasses import replace

import numpy as np
import pytest
from solved_night import off_by_sigma

from starpos.earth.place import Place
from starpos.errors import InstrumentError, PlaceError
from starpos.fix.solution import Status
from starpos.fix.solver import focal_that_fits
from starpos.identification import fisheye as wide
from starpos.identification import pose
from starpos.identification.triangles import cached_triangles
from starpos.instrument.camera import EQUIDISTANT, Camera
from starpos.instrument.inclinometer import Tilt
from starpos.navigation.sightings import sighting_of
from starpos.simulation.scene import Optics
from starpos_testing.skies.scenes import (
    random_stars,
    solver_of,
    stars_of,
    tilt_of,
    wide_scene,
    with_false_stars,
)

SIDE, FOCAL_PX = 2000, 600.0
# k1 .. k4 of a lens that is nearly equisolid: its picture ends 1.5 % nearer than an ideal one's
LENS = (-0.0417, 5e-4, 1e-5, -2e-6)


def fisheye(width=SIDE, height=SIDE, focal_px=FOCAL_PX, distortion=LENS):
    c = Camera.from_focal(width, height, focal_px, EQUIDISTANT)
    return replace(c, cx=c.cx + 4.2, cy=c.cy - 3.1, fy=c.fy * 1.001, distortion=distortion)


def scene_of_lens(camera, pointing=(40.0, 88.0, 15.0), limit_mag=5.0, **more):
    """An instrument with a fisheye, to the stars that the naked eye sees."""
    scene = wide_scene(pointing_deg=pointing, **more)
    return replace(
        scene,
        camera=camera,
        instrument=replace(scene.instrument, camera=camera, focal_px=camera.fx),
        optics=Optics(limit_mag=limit_mag, fwhm_px=2.2, sky_mag_arcsec2=21.0),
    )


@pytest.fixture(scope="module")
def night(catalogue):
    """A scene of the whole sky, the stars of one exposure, its tilt, and the solver of its instrument."""
    rng = np.random.default_rng(8)
    scene = scene_of_lens(fisheye())
    return scene, stars_of(scene, catalogue, rng), tilt_of(scene, rng), solver_of(scene, catalogue)


def test_the_whole_sky_gives_a_place_within_its_claim(night):
    scene, stars, tilt, solver = night
    s = solver.solve(stars, tilt)
    assert s.ok, s.message
    assert s.warnings == ()
    position, heading = off_by_sigma(s.fix, scene)
    assert position < 4 and abs(heading) < 4
    # all stars above 10 deg take part, to 80 deg off the zenith
    high = stars_above(scene, stars, np.radians(10.5))
    assert len(s.names) > 0.95 * high.sum()
    off = np.hypot(stars.x[s.star] - scene.camera.cx, stars.y[s.star] - scene.camera.cy)
    assert off.max() > 1.2 * FOCAL_PX
    assert s.pointing.residual_arcsec < 0.1 * scene.camera.scale_arcsec


def stars_above(scene, stars, altitude_rad):
    up = scene.camera.directions(stars.x, stars.y) @ scene.attitude[2]
    return up > np.sin(altitude_rad)


@pytest.mark.parametrize(
    ("camera", "pointing"),
    [
        (fisheye(1500, 1000, 500.0), (40.0, 60.0, 15.0)),
        (fisheye(3000, 2000, 1000.0, (0.083, 0.0083, 8e-4, 1e-4)), (200.0, 45.0, 100.0)),
        (fisheye(2400, 2400, 600.0, (-0.1, -0.0015, 0.0, 0.0)), (300.0, 80.0, -50.0)),
        (fisheye(900, 600, 900.0), (120.0, 70.0, 0.0)),
    ],
    ids=["103 deg", "stereographic", "beyond 180 deg", "62 deg"],
)
def test_other_lenses_and_leaning_ones(camera, pointing, catalogue, rng):
    scene = scene_of_lens(camera, pointing, limit_mag=5.5)
    s = solver_of(scene, catalogue).solve(stars_of(scene, catalogue, rng), tilt_of(scene, rng))
    assert s.ok, s.message
    position, heading = off_by_sigma(s.fix, scene)
    assert position < 4 and abs(heading) < 4


def test_a_fisheye_that_looks_level_sees_half_a_sky_and_none_through_the_ground(catalogue, rng):
    scene = scene_of_lens(fisheye(), (40.0, 2.0, 15.0))
    stars, tilt, solver = stars_of(scene, catalogue, rng), tilt_of(scene, rng), solver_of(scene, catalogue)
    s = solver.solve(stars, tilt)
    assert s.ok, s.message
    assert off_by_sigma(s.fix, scene)[0] < 4
    assert "below the horizon" in solver.solve(stars, turned_over(tilt)).message


def turned_over(tilt):
    """A tilt whose axes all point the other way."""
    return Tilt(
        -tilt.theta_x, -tilt.theta_y, tilt.covariance, utc_unix_s=tilt.utc_unix_s, theta_z=-tilt.theta_z
    )


@pytest.mark.montecarlo
def test_over_many_nights_the_errors_are_those_claimed(catalogue, rng):
    places, headings = [], []
    for _ in range(16):
        pointing = rng.uniform([0, 60, -180], [360, 90, 180])
        scene = scene_of_lens(fisheye(), tuple(pointing.tolist()))
        s = solver_of(scene, catalogue).solve(stars_of(scene, catalogue, rng), tilt_of(scene, rng))
        assert s.ok, s.message
        position, heading = off_by_sigma(s.fix, scene)
        places.append(position**2 / 2)
        headings.append(heading**2)
    assert np.mean(places) == pytest.approx(1, abs=4 / np.sqrt(16))
    assert np.mean(headings) < 1 + 4 * np.sqrt(2 / 16)


def test_where_the_middle_is_covered_another_part_tells(night):
    scene, stars, tilt, solver = night
    off = np.hypot(stars.x - scene.camera.cx, stars.y - scene.camera.cy)
    s = solver.solve(stars.select(off > 0.4 * FOCAL_PX), tilt)
    assert s.ok, s.message
    assert off_by_sigma(s.fix, scene)[0] < 4


def test_lights_at_the_horizon_and_beyond_the_picture_do_not_matter(night, rng):
    scene, stars, tilt, solver = night
    corner = rng.uniform(0, 40, (6, 2))
    low = np.array([scene.camera.cx, scene.camera.cy]) + 0.999 * 1.5 * FOCAL_PX * np.array(
        [[0.6, 0.8], [-1, 0]]
    )
    s = solver.solve(with_false_stars(stars, np.concatenate([corner, low])), tilt)
    assert s.ok, s.message
    assert s.star.min() >= 8 and off_by_sigma(s.fix, scene)[0] < 4


def test_an_uncalibrated_lens_is_identified(night, catalogue):
    """An ideal fisheye of that focal length, whose edge is 60 px off."""
    scene, stars, _, _ = night
    ideal = replace(scene.instrument, camera=None, model=EQUIDISTANT, focal_px=1.02 * FOCAL_PX)
    s = replace(solver_of(scene, catalogue), instrument=ideal).identify(stars)
    assert s.ok, s.message
    true = replace(solver_of(scene, catalogue)).identify(stars).pointing
    assert (s.pointing.ra, s.pointing.dec) == pytest.approx((true.ra, true.dec), abs=np.radians(0.3))


def test_a_mirrored_frame_is_said(night):
    scene, stars, tilt, solver = night
    flipped = replace(stars, y=2 * scene.camera.cy - stars.y)
    s = solver.identify(flipped)
    assert s.ok and s.pointing.mirrored
    # what stands low is raised by refraction, of which `identify` knows nothing
    assert len(s.names) > 0.8 * len(stars)
    assert "mirrored" in solver.solve(flipped, tilt).message


def test_random_points_are_no_sky(night, rng):
    _, _, _, solver = night
    for n in (0, 3, 60, 400):
        s = solver.identify(random_stars(n, rng, SIDE, SIDE))
        assert s.status in (Status.TOO_FEW_STARS, Status.NOT_IDENTIFIED)


def test_a_pinhole_of_that_field_is_refused_and_the_fisheye_named(night, catalogue):
    scene, stars, tilt, _ = night
    pinhole = replace(scene.instrument, camera=None, focal_px=FOCAL_PX)
    s = replace(solver_of(scene, catalogue), instrument=pinhole).solve(stars, tilt)
    assert "fisheye (equidistant)" in s.message


def test_a_hint_of_the_frame_before_serves(night):
    _, stars, tilt, solver = night
    first = solver.solve(stars, tilt)
    again = solver.solve(stars, tilt, first.hint)
    assert again.ok and again.names == first.names
    assert again.pointing.log_odds > first.pointing.log_odds


def test_under_way_a_fisheye_is_refused(night):
    _, stars, _, solver = night
    with pytest.raises(InstrumentError, match="fisheye"):
        sighting_of(stars, solver, solver.identify(stars))


def test_the_focal_length_that_fits_is_found(night, catalogue):
    scene, stars, _, _ = night
    off = scene.camera.scaled(0.93)
    instrument = replace(scene.instrument, camera=off, focal_px=off.fx)
    fits = focal_that_fits(replace(solver_of(scene, catalogue), instrument=instrument), stars)
    assert fits == pytest.approx(scene.camera.fx, rel=0.002)


def test_parts_look_at_the_frame_where_they_say(catalogue):
    camera = fisheye()
    x, y = np.meshgrid(np.linspace(300, 1700, 30), np.linspace(300, 1700, 30))
    directions = camera.directions(x.ravel(), y.ravel())
    made = wide.parts(wide.WideField(directions, np.full(900, 0.1), camera))
    assert len(made) == 5
    for part in made:
        seen = pose.directions(part.field.xy[:1], np.array([part.field.focal_px]))[0]
        np.testing.assert_allclose(seen @ part.turn, directions[part.row], atol=1e-12)
        assert len(part.row) > 50
    assert cached_triangles(catalogue, wide.field_rad(camera)).longest_allowed[0] == pytest.approx(
        1.37, rel=0.06
    )


def place_of(scene, east_deg=0.0):
    return Place.by_gravity(scene.site.latitude_deg, scene.site.longitude_deg + east_deg)


@pytest.mark.parametrize(("late_s", "east_deg"), [(7200.0, 0.0), (-5400.0, 0.0), (0.0, -40.0)])
def test_stars_under_the_horizon_refute_the_hour_and_the_place(night, late_s, east_deg):
    scene, stars, _, solver = night
    found = solver.identify(stars).found
    wrong = replace(stars, mid_unix_s=stars.mid_unix_s + late_s)
    with pytest.raises(PlaceError, match="would be under the horizon"):
        solver.attitude_at(wrong, found, place_of(scene, east_deg))


def test_all_stars_of_a_whole_sky_are_up_at_its_own_place(night):
    scene, stars, _, solver = night
    place = place_of(scene)
    assert solver.attitude_at(stars, solver.identify(stars).found, place).place is place

# SPDX-License-Identifier: Apache-2.0
"""A fix from a plate solver's pointing, against the truth of a simulated sky."""

from dataclasses import replace

import numpy as np
import pytest

from starpos.averaging.average import average
from starpos.calibration.misalignment import calibrate_at, turn
from starpos.fix.solution import Status
from starpos.fix.solver import Solver
from starpos.frames.tables import Pointing
from starpos.instrument.camera import Camera
from starpos.instrument.tilt_log import NO_TILTS
from starpos.rotation import half_turn
from starpos.units import ARCSEC
from starpos_testing.skies.pointings import TRUE_A3, pointed_night, without_roll
from starpos_testing.skies.scenes import AIR, solver_of, stars_of, tilt_of, wide_scene

TINY = 1e-3
EXACT = {"sigma_arcsec": TINY, "sigma_roll_arcsec": TINY, "a3_sigma_arcsec": TINY, "noise": TINY}


def solved(night, catalogue, **instrument):
    solver = Solver(replace(night.instrument, **instrument), catalogue, AIR)
    return solver, [solver.solve_pointing(p, night.tilt) for p in night.pointings]


def test_an_exact_pointing_gives_the_exact_place_and_heading(catalogue, rng):
    night = pointed_night(rng, **EXACT)
    _, answers = solved(night, catalogue)
    assert {a.status for a in answers} == {Status.OK}
    for a in answers:
        assert np.abs(night.off_m(a.fix)).max() < 2
    assert abs(half_turn(answers[-1].fix.heading - night.heading)) < 0.1 * ARCSEC
    assert answers[0].stars_detected == 0 and answers[0].pointing is None


def test_stars_and_the_pointing_of_the_same_frame_agree(catalogue, rng):
    scene = wide_scene(tilt_noise_deg=0.0, pointing_deg=(40.0, 80.0, 15.0))
    stars, tilt, solver = stars_of(scene, catalogue, rng), tilt_of(scene, rng), solver_of(scene, catalogue)
    seen = solver.identify(stars).pointing
    p = Pointing(
        mid_unix_s=stars.mid_unix_s,
        exposure_s=0.5,
        ra=seen.ra,
        dec=seen.dec,
        roll=seen.roll,
        sigma=0.5 * ARCSEC,
        sigma_roll=5 * ARCSEC,
    )
    by_stars, by_pointing = solver.solve(stars, tilt).fix, solver.solve_pointing(p, tilt).fix
    assert half_turn(by_stars.heading - by_pointing.heading) == pytest.approx(0, abs=3 * ARCSEC)
    assert by_pointing.latitude == pytest.approx(by_stars.latitude, abs=1 * ARCSEC)
    assert by_pointing.longitude == pytest.approx(by_stars.longitude, abs=1 * ARCSEC)


def test_the_errors_are_exactly_those_stated(catalogue, rng):
    """The centre's error moves the place by as much on both axes, and the roll's goes into heading and place."""
    night = pointed_night(rng, **EXACT)
    stated = replace(night.pointings[0], sigma=10 * ARCSEC, sigma_roll=10 * ARCSEC)
    solver = Solver(night.instrument, catalogue, AIR)
    term = next(t for t in solver.solve_pointing(stated, night.tilts[0]).fix.terms if t.name == "pointing")
    # one sigma for all three rotations is one sigma for any
    np.testing.assert_allclose(np.sqrt(np.diag(term.covariance)[:2]) / 6.37e6 / ARCSEC, 10, rtol=0.01)
    np.testing.assert_allclose(
        np.linalg.eigvalsh(term.covariance[:2, :2]) ** 0.5 / 6.37e6 / ARCSEC, 10, rtol=0.01
    )
    sharp = replace(stated, sigma=1e-3 * ARCSEC)
    only_roll = solver.solve_pointing(sharp, night.tilts[0]).fix
    term = next(t for t in only_roll.terms if t.name == "pointing")
    sine = np.sin(only_roll.zenith_distance)
    least, most = np.linalg.eigvalsh(term.covariance[:2, :2]) ** 0.5 / 6.37e6 / ARCSEC
    assert most == pytest.approx(10 * sine, rel=0.02) and least < 0.01


@pytest.mark.montecarlo
def test_claims_are_true_over_many_nights(catalogue):
    place, heading = [], []
    for seed in range(12):
        night = pointed_night(np.random.default_rng(seed), frames=1)
        _, answers = solved(night, catalogue)
        whole = average([a.fix for a in answers])
        place.append(night.place_nees(whole))
        heading.append(half_turn(whole.heading - night.heading) ** 2 / whole.covariance[2, 2])
    assert 1 < np.mean(place) < 3
    assert 0.5 < np.mean(heading) < 1.8


def test_a_camera_with_intrinsics_points_with_its_frames_centre(catalogue, rng):
    """Directions off the optical axis are right too, if A3 is of the real axes."""
    night = pointed_night(rng, **EXACT)
    camera = Camera(
        width=1000, height=700, fx=4636.0, fy=4630.0, cx=520.0, cy=340.0, distortion=(-0.1, 0, 0, 0, 0)
    )
    x, y = camera.centre_px
    z = camera.directions([x, x], [y, y - 1])
    up = z[1] - (z[1] @ z[0]) * z[0]
    up /= np.linalg.norm(up)
    # C of the intrinsics into the axes of the frame's centre, which the night's A3 takes into S
    to_centre = np.stack([np.cross(-up, z[0]), -up, z[0]])
    told = night.instrument.calibration.turned_to(night.instrument.calibration.a3 @ to_centre)
    _, answers = solved(night, catalogue, camera=camera, calibration=told)
    assert np.abs(night.off_m(answers[0].fix)).max() < 2


def test_a3_by_turning_and_at_a_known_place(catalogue):
    night = pointed_night(np.random.default_rng(3), frames=3, sigma_arcsec=1.0)
    solver, _ = solved(night, catalogue)
    unknown = replace(
        solver, instrument=replace(solver.instrument, calibration=type(night.instrument.calibration)())
    )
    turned = turn(unknown, night.pointings, night.tilt)
    assert night.place_nees(average(turned.fixes)) < 14
    known = calibrate_at(unknown, night.pointings, night.tilt, night.site.place)
    up = known.instrument.calibration.up
    off = (known.instrument.calibration.a3 - TRUE_A3).T @ up
    assert np.linalg.norm(off) / ARCSEC < 4 * known.plumb_stddev_arcsec


def test_faults_are_a_status_and_a_sentence(catalogue, rng):
    night = pointed_night(rng, frames=1)
    solver, _ = solved(night, catalogue)
    p, tilt = night.pointings[0], night.tilts[0]
    for frame, level, status, words in (
        (without_roll(p), tilt, Status.POOR_FIT, "no roll"),
        (p, NO_TILTS, Status.NO_TILT, "no tilt"),
        (replace(p, mid_unix_s=1e11), tilt, Status.TIME_OUTSIDE_TABLES, "IERS"),
    ):
        answer = solver.solve_pointing(frame, level)
        assert (answer.fix, answer.status) == (None, status) and words in answer.message

# SPDX-License-Identifier: Apache-2.0
"""A fix from the frames of a rolling shutter: known, unknown, and stated wrongly."""

from dataclasses import replace

import numpy as np
import pytest

from starpos.averaging.average import average
from starpos.earth.ellipsoid import curvature_radii_m
from starpos.fix.solver import Solver
from starpos.frames.exposure import GLOBAL_SHUTTER, UNKNOWN_SHUTTER, Shutter
from starpos.instrument.inclinometer import EXACT, Tilt
from starpos.instrument.instrument import Calibration
from starpos.simulation.scene import detected, expose, scene_of

START, EXPOSURE_S, READOUT_S = 1.7e9, 0.5, 0.03
PLACES = 6


def night(catalogue, readout_s, seed=3):
    """A scene of the paper's camera at a random place, 65 deg up, with the stars and the tilt of a frame."""
    rng = np.random.default_rng(seed)
    scene = scene_of(
        latitude_deg=rng.uniform(-60, 60),
        longitude_deg=rng.uniform(-180, 180),
        pointing_deg=(rng.uniform(0, 360), 65.0, rng.uniform(0, 360)),
        readout_s=readout_s,
    )
    exact = replace(
        scene.instrument,
        calibration=Calibration.of((0, 0, 0), (0.01,) * 3),
        inclinometer=replace(EXACT, noise_rad=1e-9),
        clock_stddev_s=0.0,
    )
    scene = replace(scene, instrument=exact, optics=replace(scene.optics, seeing_arcsec=0.02))
    mid = START + EXPOSURE_S / 2
    stars = detected(scene, expose(scene, catalogue, START, EXPOSURE_S, rng), mid, EXPOSURE_S, rng)
    return scene, stars, Tilt(*scene.tilt, np.eye(2) * 1e-18, utc_unix_s=mid)


def fix_of(catalogue, scene, stars, tilt, shutter, instrument=None):
    """The fix of a frame whose source states a shutter."""
    solver = Solver(instrument or scene.instrument, catalogue, scene.site.atmosphere)
    answer = solver.solve(replace(stars, shutter=shutter), tilt)
    assert answer.ok, answer.message
    return answer.fix


def off_m(fix, scene):
    """East and north (2,) in m of a fix from the truth."""
    phi, lam = np.radians([scene.site.latitude_deg, scene.site.longitude_deg])
    prime, meridian = curvature_radii_m(phi)
    return np.array([(fix.longitude - lam) * prime * np.cos(phi), (fix.latitude - phi) * meridian])


def together(catalogue, readout_s, shutter):
    """Root mean square of error and claim (m), mean chi-square, and residual (arcsec), of fixes at random places."""
    rows = []
    for seed in range(PLACES):
        scene, stars, tilt = night(catalogue, readout_s, seed)
        fix = fix_of(catalogue, scene, stars, tilt, shutter)
        off, covariance = off_m(fix, scene), fix.covariance[:2, :2]
        chi2 = off @ np.linalg.solve(covariance, off)
        rows.append((off @ off, np.trace(covariance), chi2, fix.residual_arcsec))
    error2, claim2, chi2, residual = np.mean(rows, axis=0)
    return np.sqrt(error2), np.sqrt(claim2), chi2, residual


@pytest.mark.parametrize("readout_s", [READOUT_S, -READOUT_S])
def test_a_readout_that_is_known_leaves_the_place_right_within_the_claim(catalogue, readout_s):
    error, claim, chi2, _ = together(catalogue, readout_s, Shutter(readout_s, 0.0))
    assert chi2 < 6
    assert error < 2 * claim < 40


@pytest.mark.parametrize("readout_s", [READOUT_S, -READOUT_S])
def test_an_unknown_readout_is_in_the_claim(catalogue, readout_s):
    error, claim, chi2, _ = together(catalogue, readout_s, None)
    assert chi2 < 6
    assert 15 < error < 2 * claim < 150


def test_a_readout_from_the_wrong_end_is_seen(catalogue):
    """The place is out of its claim, and the stars fit worse, twice as much as without any readout."""
    right, ignored, wrong = (
        together(catalogue, READOUT_S, s)
        for s in (Shutter(READOUT_S, 0.0), GLOBAL_SHUTTER, Shutter(-READOUT_S, 0.0))
    )
    assert ignored[2] > 20
    assert wrong[2] > 20
    assert wrong[0] > 1.5 * ignored[0] > 3 * right[0]
    assert wrong[3] > 1.2 * ignored[3] > 1.2 * right[3]


def test_what_is_not_known_of_the_shutter_does_not_average(catalogue):
    """All frames of a camera share it."""
    scene, stars, tilt = night(catalogue, 0.0)
    fix = fix_of(catalogue, scene, stars, tilt, UNKNOWN_SHUTTER)
    (term,) = (t for t in fix.terms if t.name == "shutter")
    assert term.common
    many = average([replace(fix, utc_unix_s=fix.utc_unix_s + k) for k in range(25)])
    assert np.trace(many.covariance[:2, :2]) > 0.99 * np.trace(term.covariance[:2, :2])


def test_what_the_instrument_states_counts_before_what_a_frame_states(catalogue):
    scene, stars, tilt = night(catalogue, READOUT_S)
    known = replace(scene.instrument, shutter=Shutter(READOUT_S, 0.0))
    right = fix_of(catalogue, scene, stars, tilt, Shutter(READOUT_S, 0.0))
    assert fix_of(catalogue, scene, stars, tilt, GLOBAL_SHUTTER, known).longitude == right.longitude


def test_what_all_rows_are_late_by_moves_the_place_with_the_earths_rotation(catalogue):
    """Half of the 30 ms that the readout may take are 7 m at the equator."""
    scene, stars, tilt = night(catalogue, 0.0)
    fix = fix_of(catalogue, scene, stars, tilt, Shutter(0.0, READOUT_S))
    (term,) = (t for t in fix.terms if t.name == "shutter")
    (east, north) = term.factor[:2, 1]
    assert abs(east) == pytest.approx(READOUT_S / 2 * 465.1 * np.cos(fix.latitude), rel=0.01)
    assert abs(north) < 0.01 * abs(east)

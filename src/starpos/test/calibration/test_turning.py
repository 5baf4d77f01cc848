# SPDX-License-Identifier: Apache-2.0
"""Turning on the spot: the place without a calibration, or an error that says why not."""

from dataclasses import replace

import numpy as np
import pytest

from starpos import rotation
from starpos.averaging.average import average
from starpos.calibration.misalignment import turn
from starpos.earth.ellipsoid import curvature_radii_m
from starpos.fix.solution import Status
from starpos.fix.solver import Solver
from starpos.frames.frame import no_stars
from starpos.instrument.inclinometer import Tilt, up_of
from starpos.instrument.instrument import Calibration, Instrument
from starpos.instrument.sensors import SCA100T_CALIBRATED
from starpos.instrument.tilt_log import TiltsByTime
from starpos.sky.site import camera_to_enu
from starpos.units import ARCSEC
from starpos_testing.skies.scenes import FOCAL_PX, START, stars_of, tilt_of, wide_scene


def turned(
    catalogue,
    rng,
    headings,
    misalignment=(1.5, -2.0, 130.0),
    zero_deg=(0.2, -0.1),
    lean=0.0,
    cooling=None,
    inclinometer=SCA100T_CALIBRATED,
    step_s=60.0,
):
    """Frames at these azimuths of an instrument with an unknown A3, its tilts, and the scene.

    lean: by how many deg the axis of the turn is off the plumb line.  cooling: temperatures (K,) in deg C of the
    inclinometer, the zeros' change in deg per deg C, and indices of the frames whose temperature is not known.
    """
    frames, tilts = [], {}
    for n, azimuth in enumerate(headings):
        scene = wide_scene(pointing_deg=(azimuth, 78.0 + lean * np.cos(np.radians(azimuth)), 15.0))
        instrument = replace(scene.instrument, calibration=Calibration(misalignment_deg=misalignment))
        scene = replace(scene, instrument=instrument)
        begin = START + step_s * n
        stars, tilt = stars_of(scene, catalogue, rng, begin), tilt_of(scene, rng, begin)
        frames.append(stars)
        zero, about = np.radians(zero_deg), {"utc_unix_s": stars.mid_unix_s}
        if cooling is not None:
            celsius, per_c, unmeasured = cooling
            zero = zero + np.radians(per_c) * celsius[n]
            about["temperature_c"] = np.nan if n in unmeasured else celsius[n]
        tilts[stars.mid_unix_s] = Tilt(
            tilt.theta_x + zero[0], tilt.theta_y + zero[1], tilt.covariance, **about
        )
    solver = Solver(Instrument(FOCAL_PX, inclinometer=inclinometer), catalogue, scene.site.atmosphere)
    return turn(solver, frames, TiltsByTime(tilts)), scene


def about_an_axis(catalogue, rng, headings, lean_deg, turn_stddev_deg):
    """Shots of an instrument that is turned about one axis, which leans; A3's turn given to turn_stddev_deg."""
    toward = rng.uniform(0, 2 * np.pi)
    flat = np.sin(np.radians(lean_deg)) * np.array([np.cos(toward), np.sin(toward)])
    axis, misalignment = (
        np.array([*flat, np.cos(np.radians(lean_deg))]),
        Calibration(misalignment_deg=(1.5, -2.0, 130.0)),
    )
    frames, tilts, begin = [], {}, START
    for heading in np.repeat(headings, 3):
        attitude = rotation.from_vector(-axis * np.radians(heading)) @ camera_to_enu(20.0, 78.0, 15.0)
        z = attitude[:, 2]
        azimuth, altitude = np.degrees([np.arctan2(z[0], z[1]), np.arcsin(z[2])])
        spun = camera_to_enu(azimuth, altitude, 0.0).T @ attitude
        scene = wide_scene(pointing_deg=(azimuth, altitude, -np.degrees(np.arctan2(spun[1, 0], spun[0, 0]))))
        scene = replace(scene, instrument=replace(scene.instrument, calibration=misalignment))
        stars, tilt = stars_of(scene, catalogue, rng, begin), tilt_of(scene, rng, begin)
        frames.append(stars)
        tilts[stars.mid_unix_s] = replace(tilt, utc_unix_s=stars.mid_unix_s)
        begin += 20.0
    given = Calibration()
    if turn_stddev_deg < 180:
        off = np.radians(rng.normal(0, turn_stddev_deg))
        given = given.turned_to(rotation.about_axis(2, off) @ misalignment.a3)
    known = Instrument(FOCAL_PX, calibration=given, inclinometer=SCA100T_CALIBRATED)
    solver = Solver(known, catalogue, scene.site.atmosphere)
    return turn(solver, frames, TiltsByTime(tilts), turn_stddev_deg), scene


@pytest.mark.montecarlo
@pytest.mark.parametrize(
    ("headings", "lean", "turn_stddev"),
    [((0, 180), 0.02, 180.0), ((0, 90, 180, 270), 0.3, 180.0), ((0, 180), 0.3, 2.0)],
)
def test_about_an_axis_that_leans_the_place_is_as_good_as_the_turn_is_known(
    catalogue, rng, headings, lean, turn_stddev
):
    """A3 and the zenith turned together about the axis make the same readings, however many headings there are."""
    sigmas = []
    for _ in range(3):
        answer, scene = about_an_axis(catalogue, rng, headings, lean, turn_stddev)
        place = average(answer.fixes)
        sigmas.append(miss(place, scene)[1])
        circle = np.radians(lean) * min(np.radians(turn_stddev), np.sqrt(1.5)) * 6.371e6
        assert 0.5 * circle < np.sqrt(np.linalg.eigvalsh(place.covariance[:2, :2])[-1]) < 2 * circle + 500
    assert 0.3 < np.sqrt(np.mean(np.square(sigmas))) < 2.6
    assert max(sigmas) < 4


def miss(place, scene):
    """Distance (m) and how many of its own sigma that is."""
    phi = np.radians(scene.site.latitude_deg)
    prime, meridian = curvature_radii_m(phi)
    east = (place.longitude - np.radians(scene.site.longitude_deg) + np.pi) % (2 * np.pi) - np.pi
    moved = np.array([east * prime * np.cos(phi), (place.latitude - phi) * meridian])
    return np.linalg.norm(moved), np.sqrt(moved @ np.linalg.solve(place.covariance[:2, :2], moved))


# two headings about an axis that leans have no place that is held
@pytest.mark.parametrize(
    ("headings", "lean"),
    [((0, 180), 0.0), ((10, 100, 190, 280), 0.02), ((0, 60, 120, 180, 240, 300, 0, 60), 0.7)],
)
def test_the_place_of_an_instrument_whose_a3_nobody_knows(catalogue, rng, headings, lean):
    answer, scene = turned(catalogue, rng, headings, lean=lean)
    place = average(answer.fixes)
    metres, sigmas = miss(place, scene)
    sigma = np.sqrt(np.linalg.eigvalsh(place.covariance[:2, :2])[-1])
    assert sigmas < 4
    # one reading has 12.6 arcsec, 390 m; two opposite headings share it
    assert 150 / np.sqrt(len(headings)) < sigma < 900 / np.sqrt(len(headings)) * 2
    assert metres < 4 * sigma
    assert answer.plumb_stddev_arcsec < 40


@pytest.mark.parametrize(
    "unmeasured", [(), (2,), range(12)], ids=["all measured", "one missing", "none measured"]
)
def test_a_claim_holds_while_the_inclinometer_cools(catalogue, rng, unmeasured):
    """It cools by 6 C an hour, at 20 arcsec per deg C: 1.5 km in the 24 minutes of a turn."""
    errors = replace(SCA100T_CALIBRATED, temperature_rad_per_c=20 * ARCSEC)
    sigmas = []
    for _ in range(4):
        cooling = np.linspace(12.0, 9.6, 12), rng.normal(0, 20 / 3600, 2), unmeasured
        answer, scene = turned(
            catalogue, rng, range(0, 360, 30), cooling=cooling, inclinometer=errors, step_s=120.0
        )
        sigmas.append(miss(average(answer.fixes), scene)[1])
    # two degrees of freedom: the mean square of four is below 6.7 but for once in a thousand
    assert np.mean(np.square(sigmas)) < 6.7, sigmas


def test_the_plumb_line_is_where_it_was_put(catalogue, rng):
    misalignment, zero = (1.5, -2.0, 130.0), (0.2, -0.1)
    answer, _ = turned(catalogue, rng, range(0, 360, 30), misalignment, zero)
    # What the inclinometer says, its zero off, and what is so.
    s = answer.solutions[-1].tilt
    read = s.up
    true = up_of(s.theta - np.radians(zero))
    truth = Calibration(misalignment_deg=misalignment).a3.T @ true
    found = answer.instrument.calibration.a3.T @ read
    off_arcsec = np.degrees(np.arccos(np.clip(truth @ found, -1, 1))) * 3600
    # One reading's noise is in both.
    assert off_arcsec < 4 * 12.6
    assert answer.plumb_stddev_arcsec < 10


@pytest.mark.parametrize("headings", [(20, 20, 20), (20,)])
def test_without_a_turn_the_error_is_wide(catalogue, rng, headings):
    answer, scene = turned(catalogue, rng, headings)
    place = average(answer.fixes)
    assert np.sqrt(np.diag(place.covariance)[:2]).min() > 100e3
    assert miss(place, scene)[1] < 4
    assert answer.plumb_stddev_arcsec > 3600


def test_a_small_turn_tells_little_and_says_so(catalogue, rng):
    answer, scene = turned(catalogue, rng, (0, 10))
    place = average(answer.fixes)
    assert miss(place, scene)[1] < 4
    assert np.sqrt(np.diag(place.covariance)[:2]).max() > 1500


def test_frames_without_stars_stay_without_a_fix(catalogue):
    solver = Solver(Instrument(FOCAL_PX, inclinometer=SCA100T_CALIBRATED), catalogue)
    empty = no_stars(1000, 700, mid_unix_s=START, exposure_s=0.5)
    answer = turn(solver, [empty, empty], Tilt(0.0, 0.0, np.eye(2) * 1e-10, utc_unix_s=START))
    assert [s.status for s in answer.solutions] == [Status.TOO_FEW_STARS] * 2
    assert answer.instrument.calibration.misalignment_deg == (0.0, 0.0, 0.0)


def test_a_rotation_becomes_the_three_angles_of_a3(rng):
    for _ in range(20):
        a3 = rotation.from_vector(rng.normal(size=3) * [0.3, 0.3, 2.0])
        np.testing.assert_allclose(Calibration().turned_to(a3).a3, a3, atol=1e-12)

# SPDX-License-Identifier: Apache-2.0
"""A camera that is fixed to the ground: its vertical, and whether it has moved since."""

from dataclasses import replace

import numpy as np
import pytest

from starpos import rotation
from starpos.calibration.misalignment import calibrate_fixed
from starpos.earth.place import Place
from starpos.errors import FixError, InstrumentError
from starpos.fix.solution import Status
from starpos.fix.solver import Solver
from starpos.instrument import instrument_file
from starpos.instrument.instrument import Instrument
from starpos.rotation import half_turn
from starpos.sky.site import Site, camera_to_enu
from starpos.units import ARCSEC, HOUR_S
from starpos_testing.skies.pointings import pointing_of
from starpos_testing.skies.scenes import AIR

BEGIN = 1.79e9
SAG_ARCSEC = 20.0
POINTED = {"sigma": 2 * ARCSEC, "sigma_roll": 20 * ARCSEC}


def pose(azimuth_deg=40.0, altitude_deg=70.0):
    return camera_to_enu(azimuth_deg, altitude_deg, 15.0)


def frames_of(site, attitude, begin, rng, number=3):
    return [pointing_of(site, attitude, begin + 20 * k, rng, **POINTED) for k in range(number)]


@pytest.fixture
def site(rng):
    return Site(rng.uniform(-65, 65), rng.uniform(-180, 180), AIR)


@pytest.fixture
def solver(catalogue):
    return Solver(Instrument(1e4), catalogue, AIR)


def calibrated(solver, site, rng, attitude=None):
    frames = frames_of(site, pose() if attitude is None else attitude, BEGIN, rng)
    found = calibrate_fixed(solver, frames, site.place, sag_arcsec_per_sqrt_hour=SAG_ARCSEC)
    return replace(solver, instrument=found.instrument)


def sagged(rng, hours, attitude):
    return rotation.from_vector(rng.normal(0, SAG_ARCSEC * ARCSEC * np.sqrt(hours), 3)) @ attitude


def test_place_and_heading_need_no_tilt(solver, site, rng):
    ready = calibrated(solver, site, rng)
    (frame,) = frames_of(site, pose(), BEGIN + 24 * HOUR_S, rng, 1)
    fix = ready.solve_pointing(frame).fix
    assert abs(np.degrees(fix.latitude) - site.latitude_deg) < 40 / 3600
    forward = -pose()[:, 1]
    truth = np.arctan2(forward[0], forward[1])
    assert half_turn(fix.heading - truth) == pytest.approx(0, abs=60 * ARCSEC)
    sigma = np.sqrt(fix.covariance[1, 1]) / 6.37e6 / ARCSEC
    assert sigma == pytest.approx(SAG_ARCSEC * np.sqrt(24), rel=0.05)


@pytest.mark.montecarlo
def test_claims_are_true_of_cameras_that_sag_as_stated(solver):
    place, heading = [], []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        site = Site(rng.uniform(-65, 65), rng.uniform(-180, 180), AIR)
        first = pose(rng.uniform(0, 360), rng.uniform(60, 80))
        ready, hours = calibrated(solver, site, rng, first), rng.uniform(1, 200)
        now = sagged(rng, hours, first)
        (frame,) = frames_of(site, now, BEGIN + hours * HOUR_S, rng, 1)
        answer = ready.solve_pointing(frame)
        assert answer.fix, answer.message
        fix, forward = answer.fix, -now[:, 1]
        off = np.radians([half_turn_deg(np.degrees(fix.longitude) - site.longitude_deg), 0])
        off[1] = fix.latitude - np.radians(site.latitude_deg)
        off *= 6.37e6 * np.array([np.cos(fix.latitude), 1])
        place.append(off @ np.linalg.solve(fix.covariance[:2, :2], off))
        wrong = half_turn(fix.heading - np.arctan2(forward[0], forward[1]))
        heading.append(wrong**2 / fix.covariance[2, 2])
    assert 1.2 < np.mean(place) < 3
    assert 0.5 < np.mean(heading) < 1.7


def half_turn_deg(deg):
    return (deg + 180) % 360 - 180


@pytest.mark.parametrize(
    "moved",
    [
        lambda site: (site, pose(40.3)),
        lambda site: (site, pose(40, 70.3)),
        lambda site: (Site(site.latitude_deg - 0.5, site.longitude_deg, AIR), pose()),
        lambda site: (Site(-site.latitude_deg, site.longitude_deg + 180, AIR), pose()),
    ],
    ids=["turned", "tipped", "carried 55 km", "carried round the Earth"],
)
def test_a_camera_that_was_moved_says_so(moved, solver, site, rng):
    ready = calibrated(solver, site, rng)
    there, attitude = moved(site)
    (frame,) = frames_of(there, attitude, BEGIN + 4 * HOUR_S, rng, 1)
    answer = ready.solve_pointing(frame)
    assert (answer.fix, answer.status) == (None, Status.POOR_FIT)
    assert "the camera has moved, by " in answer.message


def test_a_clock_that_is_off_is_no_other_place(solver, site, rng):
    ready = calibrated(solver, site, rng)
    (frame,) = frames_of(site, pose(), BEGIN + HOUR_S, rng, 1)
    answer = ready.solve_pointing(replace(frame, mid_unix_s=frame.mid_unix_s + 60))
    assert answer.fix is None and "or the clock is off" in answer.message


def test_a_camera_touched_between_its_frames_has_no_vertical(solver, site, rng):
    frames = [*frames_of(site, pose(), BEGIN, rng), *frames_of(site, pose(41.0), BEGIN + 100, rng)]
    with pytest.raises(FixError, match=r"touched between|do not agree|disagree"):
        calibrate_fixed(solver, frames, site.place)


def test_a_wrong_place_that_shows_is_refused(solver, site, rng):
    frames = frames_of(site, pose(), BEGIN, rng)
    with pytest.raises(FixError, match="into the ground"):
        calibrate_fixed(solver, frames, Place.by_gravity(-site.latitude_deg, site.longitude_deg + 180))


def test_the_file_keeps_it(solver, site, rng, tmp_path):
    ready = calibrated(solver, site, rng).instrument
    instrument_file.write(tmp_path / "v.yaml", ready)
    again = instrument_file.read(tmp_path / "v.yaml")
    assert again.vertical == ready.vertical
    assert again.inclinometer.drift_rad_per_sqrt_hour == pytest.approx(SAG_ARCSEC * ARCSEC)
    assert again.inclinometer.noise_rad == ready.inclinometer.noise_rad
    assert "tilt_" not in (tmp_path / "v.yaml").read_text().replace("tilt_deg", "")


GOOD = "camera_to_itrs: [[1,0,0],[0,1,0],[0,0,1]], covariance_arcsec2: [[1,0,0],[0,1,0],[0,0,1]]"
DATED = "calibrated: {utc: 2026-11-02T18:00:00}\n"
BROKEN = {
    "no mapping": (DATED + "vertical: 3", "vertical is 3: give"),
    "another key": (DATED + f"vertical: {{{GOOD}, up: 3}}", "unknown key 'up'"),
    "no sag": (DATED + f"vertical: {{{GOOD}}}", "sag_arcsec_per_sqrt_hour is missing"),
    "a negative sag": (DATED + f"vertical: {{{GOOD}, sag_arcsec_per_sqrt_hour: -1}}", "from 0 to 3600"),
    "nan": (DATED + f"vertical: {{{GOOD}, sag_arcsec_per_sqrt_hour: .nan}}", "from 0 to 3600"),
    "no date": (f"vertical: {{{GOOD}, sag_arcsec_per_sqrt_hour: 1}}", "say when it was found"),
    "an inclinometer": (
        DATED + f"tilt_noise_deg: 1\nvertical: {{{GOOD}, sag_arcsec_per_sqrt_hour: 1}}",
        "leave out inclinometer and the tilt_ keys",
    ),
    "no rotation": (
        DATED + f"vertical: {{{GOOD.replace('[[1,0', '[[2,0', 1)}, sag_arcsec_per_sqrt_hour: 1}}",
        "must be a 3 x 3 rotation matrix",
    ),
    "a mirror": (
        DATED + f"vertical: {{{GOOD.replace('[[1,0', '[[-1,0', 1)}, sag_arcsec_per_sqrt_hour: 1}}",
        "must be a 3 x 3 rotation matrix",
    ),
    "infinite": (
        DATED + f"vertical: {{{GOOD.replace('[[1,0', '[[.inf,0', 1)}, sag_arcsec_per_sqrt_hour: 1}}",
        "must be a 3 x 3 rotation matrix",
    ),
    "a negative variance": (
        DATED + f"vertical: {{{GOOD.replace('2: [[1', '2: [[-1')}, sag_arcsec_per_sqrt_hour: 1}}",
        "without negative variances",
    ),
}


@pytest.mark.parametrize("kind", BROKEN)
def test_a_vertical_that_is_none_is_refused(kind, tmp_path):
    text, words = BROKEN[kind]
    path = tmp_path / "v.yaml"
    path.write_text(f"starpos_instrument: 1\ncamera: {{focal_px: 5000}}\n{text}\n")
    with pytest.raises(InstrumentError, match=words):
        instrument_file.read(path)

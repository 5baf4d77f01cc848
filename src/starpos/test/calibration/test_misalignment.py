# SPDX-License-Identifier: Apache-2.0
"""A3 at a known place, and what an instrument calibrated there claims elsewhere, against simulated truth."""

from dataclasses import replace

import numpy as np
import pytest

from starpos.averaging.average import average
from starpos.calibration.misalignment import VALID_DAYS, calibrate_at
from starpos.earth.ellipsoid import curvature_radii_m
from starpos.earth.place import Place
from starpos.earth.vertical import Deflection
from starpos.errors import FixError
from starpos.fix.solution import Status
from starpos.frames.frame import no_stars
from starpos.instrument.inclinometer import EXACT
from starpos.instrument.instrument import Calibration
from starpos.units import DAY_S
from starpos_testing.skies.scenes import START
from starpos_testing.skies.sites import TRUE_A3_DEG, a3_error, shots

# Errors of one reading.
NOISE_ARCSEC = 12.6


def found_at(shot, catalogue, given=(0.0, 0.0, 0.0), **more):
    return calibrate_at(shot.solver(catalogue, given), shot.frames, shot.tilt, shot.scene.site.place, **more)


def stddev(calibration) -> np.ndarray:
    return np.sqrt(np.diag(calibration.covariance_arcsec2))


def solved(shot, found, catalogue):
    """The first frame of these shots with a calibrated instrument, and how far that is off, in m and in sigma."""
    solver = replace(shot.solver(catalogue), instrument=found.instrument)
    solution = solver.solve(shot.frames[0], shot.tilt)
    assert solution.status is Status.OK, solution.message
    f = solution.fix
    phi, lam = np.radians([shot.scene.site.latitude_deg, shot.scene.site.longitude_deg])
    prime, meridian = curvature_radii_m(phi)
    off = np.array([(f.longitude - lam) * prime * np.cos(phi), (f.latitude - phi) * meridian])
    return f, np.linalg.norm(off), np.sqrt(off @ np.linalg.solve(f.covariance[:2, :2], off))


def sigma_m(f) -> float:
    return float(np.sqrt(np.linalg.eigvalsh(f.covariance[:2, :2])[-1]))


def budget_m(f, name) -> np.ndarray:
    (term,) = (t for t in f.terms if t.name == name)
    return np.sqrt(np.diag(term.covariance)[:2])


# a few frames cannot exclude that they scatter more than they say
WIDER = 1.3


@pytest.mark.parametrize("frames", [1, 5])
def test_one_lean_is_right_at_that_lean_and_wide_at_another(catalogue, rng, frames):
    shot = shots(catalogue, rng, [0.0] * frames)
    found = found_at(shot, catalogue)
    assert 0.9 < found.plumb_stddev_arcsec / (NOISE_ARCSEC / np.sqrt(frames)) < WIDER
    assert np.sqrt(np.linalg.eigvalsh(found.instrument.calibration.covariance_arcsec2)[-1]) > 90 * 3600
    same, metres, sigmas = solved(shots(catalogue, rng, [0.0], start=START + 900), found, catalogue)
    assert sigmas < 4
    # the noise of both readings, 390 m each, and the lean by which they differ, turned by an unknown angle
    assert metres < 4 * 390 * np.sqrt(1 + 1 / frames)
    assert sigma_m(same) < 3000
    # As wide as the turn is unknown: sideways and, beyond half a turn, along the lean.
    for lean in (-4.0, 4.0):
        there = shots(catalogue, rng, [lean], start=START + 900)
        other, metres, sigmas = solved(there, found, catalogue)
        assert sigmas < 3
        assert metres > 100e3
        assert np.sqrt(np.linalg.eigvalsh(other.covariance[:2, :2])[0]) > 0.3 * metres


@pytest.mark.parametrize("given", [(0.0, 0.0, 0.0), (-5.0, 5.0, -50.0)])
def test_two_leans_tell_all_of_a3(catalogue, rng, given):
    shot = shots(catalogue, rng, [0.0, 0.0, 6.0, 6.0])
    found = found_at(shot, catalogue, given)
    off, chi2 = a3_error(shot, found.instrument.calibration)
    assert np.all(np.abs(off) < 4 * stddev(found.instrument.calibration))
    assert chi2 < 25
    # 12.6 arcsec / sqrt(2) at both ends of 6 deg, of which one axis across determines the turn
    turn = np.sqrt(np.linalg.eigvalsh(found.instrument.calibration.covariance_arcsec2)[-1])
    # two leans cannot separate it from axes that are not square
    assert 0.7 < turn / (NOISE_ARCSEC / np.sin(np.radians(6))) < 3
    elsewhere, metres, sigmas = solved(shots(catalogue, rng, [-3.0], start=START + 900), found, catalogue)
    assert sigmas < 4
    assert metres < 4 * sigma_m(elsewhere) < 4 * 1800


@pytest.mark.montecarlo
def test_a3_errs_as_its_covariance_says(catalogue):
    """Chi-squares of ten calibrations average to the 3 that three angles have."""
    chi2 = []
    for seed in range(10):
        shot = shots(catalogue, np.random.default_rng(seed), [0.0, 5.0, -4.0])
        chi2.append(a3_error(shot, found_at(shot, catalogue).instrument.calibration)[1])
    assert np.mean(chi2) == pytest.approx(3, abs=3.5 * np.sqrt(6 / 10))


TEN = [0.0] * 5 + [5.0] * 5


@pytest.fixture(scope="module")
def ten(catalogue):
    """The calibration of ten sound frames, and its error (3,)."""
    sound = shots(catalogue, np.random.default_rng(7), TEN)
    found = found_at(sound, catalogue).instrument.calibration
    return found, a3_error(sound, found)[0]


@pytest.mark.montecarlo
@pytest.mark.parametrize(("which", "off_deg"), [(4, 0.02), (9, 0.1), (0, 1.0), (4, -20.0)])
def test_a_bad_tilt_among_ten_does_not_move_it(catalogue, ten, which, off_deg):
    """Refused or carried along, a reading that is degrees off cost the calibration; its frame is left out instead."""
    expected, expected_off = ten
    shot = shots(catalogue, np.random.default_rng(7), TEN)
    shot.spoil(which, off_deg)
    found = found_at(shot, catalogue).instrument.calibration
    off, chi2 = a3_error(shot, found)
    moved = np.abs(off - expected_off)
    # Six sigma: it is hardly one, and pulls as hard as three.
    if abs(off_deg) < 0.05:
        assert chi2 < 20
        return
    assert np.all(moved < stddev(expected))
    assert found.frames == 9
    assert stddev(found) == pytest.approx(stddev(expected), rel=0.15)


@pytest.mark.parametrize(("off_deg", "named"), [(0.3, True), (-4.0, True), (0.0, False)])
def test_one_bad_tilt_among_five_headings_is_named_and_left_out(catalogue, rng, off_deg, named):
    shot = shots(catalogue, rng, [0.0] * 5)
    shot.spoil(3, off_deg)
    found = found_at(shot, catalogue)
    said = [s.message for s in found.solutions if s.fix is None]
    assert len(said) == named
    assert all("its tilt is off by" in message for message in said)
    assert [s.fix is None for s in found.solutions].index(True) == 3 if named else True
    assert found.beyond == "" and found.plumb_stddev_arcsec < 30


def test_five_headings_that_all_scatter_are_all_used(catalogue, rng):
    shot = shots(catalogue, rng, [0.0] * 5)
    for k, off_deg in enumerate(rng.normal(0, 0.05, 5)):
        shot.spoil(k, off_deg)
    found = found_at(shot, catalogue)
    assert len(found.fixes) == 5 and found.beyond


@pytest.mark.parametrize("bad", [[0], [0, 1], [1, 2, 3]])
def test_frames_that_do_not_agree(catalogue, rng, bad):
    """No noise of any inclinometer explains degrees: which of two or four frames are right is undetermined."""
    shot = shots(catalogue, rng, [0.0] * max(2, 2 * len(bad)))
    for k in bad:
        shot.spoil(k, 2.0 * (k + 1))
    with pytest.raises(FixError, match=r"frames do not agree on one zenith .* was moved") as e:
        found_at(shot, catalogue)
    assert "\n" not in str(e.value)


def test_frames_that_noise_explains_are_not_refused_but_claim_little(catalogue, rng):
    """Two frames of one pose 0.2 deg apart, of a sensor said to have a noise of 0.0035 deg."""
    shot = shots(catalogue, rng, [0.0, 0.0])
    shot.spoil(0, 0.2)
    found = found_at(shot, catalogue)
    assert 0.05 < found.plumb_stddev_arcsec / 3600 < 0.5
    assert "more than the inclinometer's stated errors" in found.beyond and "state tilt_" in found.beyond
    assert found_at(shots(catalogue, rng, [0.0] * 4), catalogue).beyond == ""


@pytest.mark.montecarlo
def test_frames_that_scatter_more_than_they_say_claim_less(catalogue):
    """A mount that creeps by 24 arcsec from frame to frame, which is not stated."""
    calm, creeping = (shots(catalogue, np.random.default_rng(3), [0.0] * 8) for _ in range(2))
    rng = np.random.default_rng(4)
    for k in range(8):
        creeping.spoil(k, rng.normal(0, 24 / 3600))
    claims = [found_at(s, catalogue).plumb_stddev_arcsec for s in (calm, creeping)]
    assert 0.9 < claims[0] / (NOISE_ARCSEC / np.sqrt(8)) < WIDER
    assert 2 < claims[1] / claims[0] < 4


def test_frames_of_one_reading_know_no_more_than_one(catalogue, rng):
    shot = shots(catalogue, rng, [0.0] * 6)
    first = shot.tilts[shot.frames[0].mid_unix_s]
    shot.tilts = dict.fromkeys(shot.tilts, replace(first, times=(START,)))
    assert found_at(shot, catalogue).plumb_stddev_arcsec == pytest.approx(NOISE_ARCSEC, rel=0.1)


def test_without_a_fix_there_is_no_calibration(catalogue, rng):
    shot = shots(catalogue, rng)
    solver = shot.solver(catalogue)
    with pytest.raises(FixError, match="there is no frame"):
        calibrate_at(solver, [], shot.tilt, shot.scene.site.place)
    shot.frames = [no_stars(1000, 700, mid_unix_s=START, exposure_s=0.5)]
    with pytest.raises(FixError, match=r"no frame has a fix to calibrate from: .*0 stars detected"):
        calibrate_at(solver, shot.frames, next(iter(shot.tilts.values())), shot.scene.site.place)


def test_frames_without_a_fix_are_left_out(catalogue, rng):
    shot = shots(catalogue, rng, [0.0] * 3)
    empty = no_stars(1000, 700, mid_unix_s=START + 7, exposure_s=0.5)
    shot.tilts[START + 7] = shot.tilts[shot.frames[0].mid_unix_s]
    shot.frames.insert(1, empty)
    found = found_at(shot, catalogue)
    assert [s.status for s in found.solutions] == [Status.OK, Status.TOO_FEW_STARS, Status.OK, Status.OK]
    assert found.instrument.calibration.frames == len(found.fixes) == 3


def test_a_site_that_is_not_known_well(catalogue, rng):
    shot = shots(catalogue, rng, [0.0] * 9)
    site = shot.scene.site
    sharp, blunt = (
        calibrate_at(
            shot.solver(catalogue),
            shot.frames,
            shot.tilt,
            Place.on_ellipsoid(site.latitude_deg, site.longitude_deg, Deflection(0.0, 0.0, s)),
        ).plumb_stddev_arcsec
        for s in (0.0, 30.0)
    )
    assert 0.9 < sharp / (NOISE_ARCSEC / 3) < WIDER
    assert blunt == pytest.approx(np.hypot(sharp, 30.0), rel=0.05)


def test_a_site_that_is_off_moves_a3_by_as_much(catalogue):
    """18.5 arcsec of latitude: the plumb line is that far off, and a fix lands on the site that was said."""
    shot = shots(catalogue, np.random.default_rng(5), [0.0] * 4, noise_deg=1e-5)
    site = replace(shot.scene.site, latitude_deg=shot.scene.site.latitude_deg + 18.5 / 3600)
    found = calibrate_at(shot.solver(catalogue), shot.frames, shot.tilt, site.place)
    up = shot.scene.attitude[2]
    said = found.instrument.calibration.a3.T @ shot.true_a3 @ up
    assert np.degrees(np.arccos(said @ up)) * 3600 == pytest.approx(18.5, abs=0.3)
    f, _, _ = solved(shot, found, catalogue)
    assert np.degrees(f.latitude) == pytest.approx(site.latitude_deg, abs=0.3 / 3600)
    assert np.degrees(f.longitude) == pytest.approx(site.longitude_deg, abs=0.3 / 3600)


@pytest.mark.parametrize(
    ("a3_deg", "given"),
    [
        ((1.0, -2.0, 180.0), (0.0, 0.0, 179.9)),
        ((0.5, 0.5, -179.9999), (0.0, 0.0, 179.9)),
        ((-2.0, 1.0, 179.99999), (0.0, 0.0, 0.0)),
    ],
)
def test_a_camera_the_other_way_round_than_the_inclinometer(catalogue, rng, a3_deg, given):
    shot = shots(catalogue, rng, [0.0, 5.0, -5.0], a3_deg)
    found = found_at(shot, catalogue, given)
    assert a3_error(shot, found.instrument.calibration)[1] < 25
    assert solved(shot, found, catalogue)[2] < 4


def test_an_inclinometer_at_a_right_angle_to_the_camera(catalogue, rng):
    """A camera that looks along the inclinometer's X'... leaning as it does at 78 deg by 12: ry near 78 of 90 deg."""
    shot = shots(catalogue, rng, [0.0, 3.0], (0.0, 20.0, 10.0))
    found = found_at(shot, catalogue)
    assert a3_error(shot, found.instrument.calibration)[1] < 25


def test_what_is_said_of_the_turn_holds_where_the_leans_tell_little(catalogue, rng):
    shot = shots(catalogue, rng, [0.0] * 4)
    near = (1.5, -2.0, 128.0)
    told = found_at(shot, catalogue, near, turn_stddev_deg=2.0).instrument.calibration
    turn = np.sqrt(np.linalg.eigvalsh(told.covariance_arcsec2)[-1]) / 3600
    assert turn == pytest.approx(2.0, rel=0.02)
    # As it was said to be.
    assert told.misalignment_deg[2] == pytest.approx(128.0, abs=0.2)
    assert a3_error(shot, told)[1] < 16
    # against leans that determine it to 0.04 deg it has no weight
    leaning = shots(catalogue, rng, [0.0, 0.0, 6.0, 6.0])
    free, held = (
        found_at(leaning, catalogue, near, turn_stddev_deg=t).instrument.calibration for t in (180, 2.0)
    )
    assert held.misalignment_deg[2] == pytest.approx(free.misalignment_deg[2], abs=0.01)


def test_a_turn_said_wide_counts_from_what_was_said(catalogue):
    """Leans determine the turn to some 20 deg, and the stated one is good to 30: the answer lies between the two."""
    shot = shots(catalogue, np.random.default_rng(2), [0.0, 0.01])
    for said in (130.0, 100.0, 40.0):
        c = found_at(shot, catalogue, (1.5, -2.0, said), turn_stddev_deg=30.0).instrument.calibration
        turn = np.sqrt(np.linalg.eigvalsh(c.covariance_arcsec2)[-1]) / 3600
        assert turn < 30.5
        assert abs((c.misalignment_deg[2] - said + 180) % 360 - 180) < 3 * 30


def test_time_temperature_tilt_and_number_are_recorded(catalogue, rng):
    shot = shots(catalogue, rng, [0.0, 4.0])
    for mid, t in shot.tilts.items():
        # 10 and 12.
        shot.tilts[mid] = replace(t, temperature_c=10.0 + (mid - START - 0.25) / 10)
    c = found_at(shot, catalogue).instrument.calibration
    mids = list(shot.tilts)
    assert c.utc_unix_s == pytest.approx(np.mean(mids), abs=1e-6)
    assert c.temperature_c == pytest.approx(11.0)
    up = np.mean([t.up for t in shot.tilts.values()], axis=0)
    assert c.tilt_deg == pytest.approx(np.degrees(np.arcsin(up / np.linalg.norm(up)))[:2])
    assert (c.frames, c.valid_days) == (2, VALID_DAYS)
    silent = shots(catalogue, rng)
    assert np.isnan(found_at(silent, catalogue).instrument.calibration.temperature_c)


def test_what_the_calibration_costs_elsewhere_and_later(catalogue, rng):
    """Numbers worked out by hand from the inclinometer's: 2 arcsec / sqrt(h), 3 arcsec / deg C, 1e-4 of the angle."""
    shot = shots(catalogue, rng, [0.0, 0.0])
    for mid, t in shot.tilts.items():
        shot.tilts[mid] = replace(t, temperature_c=10.0)
    found = found_at(shot, catalogue)
    arcsec_m = 30.9
    for days, warmer, lean in ((0.25, 0.0, 0.0), (4.0, 10.0, 0.0), (9.0, -5.0, -6.0)):
        there = shots(
            catalogue, rng, [lean], start=START + days * DAY_S, latitude_deg=-20.0, longitude_deg=130.0
        )
        for mid, t in there.tilts.items():
            there.tilts[mid] = replace(t, temperature_c=10.0 + warmer)
        f, metres, sigmas = solved(there, found, catalogue)
        assert sigmas < 4
        # A2's axes at some degrees of lean, and the radii of the Earth, are not quite one.
        flat = 0.06 * arcsec_m
        drift = 2.0 * np.sqrt(24 * days) * arcsec_m
        assert budget_m(f, "tilt drift") == pytest.approx(drift, rel=0.05)
        assert budget_m(f, "tilt temperature") == pytest.approx(3.0 * abs(warmer) * arcsec_m, rel=0.05)
        scale = 1e-4 * abs(lean) * 3600 * arcsec_m
        assert np.linalg.norm(budget_m(f, "tilt response")) == pytest.approx(scale, rel=0.05, abs=flat)
        assert metres < 4 * sigma_m(f)


def test_a_stale_calibration_is_refused_in_words(catalogue, rng):
    shot = shots(catalogue, rng)
    found = found_at(shot, catalogue)
    for days, ok in ((VALID_DAYS - 1, True), (VALID_DAYS + 1, False), (-VALID_DAYS - 1, False)):
        # The past is in all tables.
        later = shots(catalogue, rng, start=START - days * DAY_S)
        solver = replace(shot.solver(catalogue), instrument=found.instrument)
        solution = solver.solve(later.frames[0], later.tilt)
        assert (solution.status is Status.OK) == ok
        if not ok:
            assert solution.status is Status.BAD_INPUT
            assert "2026-11-02T18:00:00" in solution.message
            assert "calibrate again" in solution.message


def test_an_old_calibration_does_not_stop_a_new_one(catalogue, rng):
    shot = shots(catalogue, rng)
    stale = replace(
        Calibration(misalignment_deg=TRUE_A3_DEG), utc_unix_s=START - 900 * DAY_S, valid_days=10.0
    )
    solver = shot.solver(catalogue)
    solver = replace(solver, instrument=replace(solver.instrument, calibration=stale))
    found = calibrate_at(solver, shot.frames, shot.tilt, shot.scene.site.place)
    assert found.instrument.calibration.utc_unix_s == shot.frames[0].mid_unix_s


def test_the_fixes_of_a_calibration_do_not_know_its_place(catalogue, rng):
    """They were made with an A3 that came of the site: to average them is not to measure it."""
    found = found_at(shots(catalogue, rng, [0.0] * 3), catalogue)
    assert np.sqrt(np.diag(average(found.fixes).covariance)[:2]).min() > 100e3


def test_a_steadier_inclinometer_is_taken_at_its_word(catalogue):
    """0.1 arcsec: A3 to a fraction of an arcsec, and true."""
    noise = 0.1 / 3600
    shot = shots(catalogue, np.random.default_rng(11), [0.0, 0.0, 4.0, 4.0], noise_deg=noise)
    errors = replace(EXACT, noise_rad=np.radians(noise), quantum_rad=np.radians(noise) / 8)
    solver = shot.solver(catalogue)
    solver = replace(solver, instrument=replace(solver.instrument, inclinometer=errors, clock_stddev_s=0.0))
    found = calibrate_at(solver, shot.frames, shot.tilt, shot.scene.site.place)
    assert found.plumb_stddev_arcsec < 0.3
    assert a3_error(shot, found.instrument.calibration)[1] < 25

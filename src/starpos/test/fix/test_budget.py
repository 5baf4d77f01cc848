# SPDX-License-Identifier: Apache-2.0
"""The inclinometer's own sources of error, against numbers worked out by other means."""

from dataclasses import replace

import numpy as np
import pytest

from starpos import rotation
from starpos.earth.orientation import earth_state
from starpos.fix.terms import Origin
from starpos.instrument.inclinometer import InclinometerErrors, Tilt
from starpos.instrument.instrument import Calibration
from starpos.units import ARCSEC
from starpos_testing.skies.fields import QUIET, UTC, SkyField

STATE = earth_state(UTC)
# East, north at 35.7 deg, radii of WGS 84.
ARCSEC_M = (30.95, 30.82)


def fixed(field, rng, errors=QUIET, turn_sigma=0.0, **calibration):
    """A fix of a field whose camera is the inclinometer's frame."""
    xy, places = field.places(STATE, rng)
    known = replace(
        Calibration.of(field.misalignment, (0.0, 0.0, turn_sigma / ARCSEC)),
        **calibration,
    )
    told = replace(field.instrument(), calibration=known, inclinometer=errors)
    return field.solve(xy, places, STATE, instrument=told, tilt=replace(field.tilt(), temperature_c=20.0))


def sigma_m(fix, name) -> np.ndarray:
    (term,) = (t for t in fix.terms if t.name == name)
    return np.sqrt(np.diag(term.covariance)[:2])


def test_each_term_says_whether_gnss_replaces_it(rng):
    """A term of the level with the wrong origin would be counted twice, or not at all, once GNSS has taught the rest."""
    of = {origin: {t.name for t in fixed(SkyField(), rng).terms if t.origin is origin} for origin in Origin}
    others = {
        "centroids",
        "catalogue",
        "refraction",
        "shutter",
        "clock",
        "time stamp",
        "ut1",
        "pole",
        "mount",
    }
    assert of.pop(Origin.OTHER) <= others
    assert of == {
        Origin.A3: {"calibration", "remounting"},
        Origin.INCLINOMETER: {
            "tilt quantisation",
            "tilt pose",
            "tilt drift",
            "tilt temperature",
            "tilt response",
        },
        Origin.READINGS: {"tilt"},
    }


def test_drift_grows_with_the_root_of_the_hours(rng):
    errors = replace(QUIET, drift_rad_per_sqrt_hour=2 * ARCSEC)
    field = SkyField(altitude=89.9)
    for hours in (1.0, 16.0, 240.0, -16.0):
        fix = fixed(field, rng, errors, utc_unix_s=UTC - 3600 * hours)
        assert sigma_m(fix, "tilt drift") == pytest.approx(
            2 * np.sqrt(abs(hours)) * np.array(ARCSEC_M), rel=0.01
        )
    # Since an unknown time.
    assert sigma_m(fixed(field, rng, errors), "tilt drift").max() == 0


def test_temperature_by_the_degree(rng):
    errors = replace(QUIET, temperature_rad_per_c=3 * ARCSEC)
    field = SkyField(altitude=89.9)
    for told, warmer in ((10.0, 10.0), (25.0, -5.0), (20.0, 0.0)):
        fix = fixed(field, rng, errors, temperature_c=told)
        assert sigma_m(fix, "tilt temperature") == pytest.approx(
            3 * abs(warmer) * np.array(ARCSEC_M), rel=0.01
        )
    assert sigma_m(fixed(field, rng, errors), "tilt temperature").max() == 0


def test_scale_counts_from_the_tilt_it_was_calibrated_at(rng):
    """1e-4 of 10 deg is 3.6 arcsec, 111 m."""
    errors = replace(QUIET, scale=1e-4)
    # Leans to the north, about the camera's x axis alone.
    field = SkyField(azimuth=0.0, altitude=80.0, roll=0.0)
    fix = fixed(field, rng, errors)
    east, north = sigma_m(fix, "tilt response")
    assert north == pytest.approx(3.6 * ARCSEC_M[1], rel=0.01)
    assert east < 0.5
    lean_deg = np.degrees(field.tilt().theta)
    there = fixed(field, rng, errors, tilt_deg=tuple(lean_deg))
    assert sigma_m(there, "tilt response").max() < 1e-6
    half = fixed(field, rng, errors, tilt_deg=tuple(lean_deg / 2))
    assert sigma_m(half, "tilt response")[1] == pytest.approx(1.8 * ARCSEC_M[1], rel=0.02)


@pytest.mark.parametrize("turn_deg", [0.1, 5.0, 60.0, 180.0])
def test_an_unknown_turn_against_instruments_turned_at_random(turn_deg, rng):
    """Place errors of A3s turned about the plumb line by a Gaussian of that size, used at 5 deg of lean: never claimed
    smaller than they are, and hardly larger as long as the turn is small."""
    field = SkyField(azimuth=20.0, altitude=85.0, roll=30.0)
    sigma = np.radians(turn_deg)
    fix = fixed(field, rng, turn_sigma=sigma)
    claimed = sum(t.covariance for t in fix.terms if t.name == "calibration")[:2, :2]
    up = field.attitude[2]
    moved = []
    for angle in rng.normal(0, sigma, 4000):
        # The plumb line in S, which is the zenith's.
        off = rotation.about_axis(2, angle) @ up - up
        moved.append((field.attitude @ off)[:2] * 6.378e6)
    real = np.cov(np.array(moved).T) + np.outer(np.mean(moved, 0), np.mean(moved, 0))
    # Between the Earth's two radii.
    floor = np.eye(2) * 1e-3 * np.trace(claimed)
    share = np.linalg.eigvals(np.linalg.solve(claimed + floor, real + floor)).real
    assert share.max() < 1.15
    if turn_deg < 10:
        assert share.max() > 0.85


@pytest.mark.parametrize("noise", [0.0, 0.2, 0.5, 1.0])
def test_what_rounding_leaves_in_a_mean(noise, rng):
    """Rounded readings of angles anywhere on the step: the error of their mean compared with their noise's own."""
    quantum, n, angles = 1e-5, 400, 3000
    true = rng.uniform(-0.5, 0.5, angles) * quantum
    own = rng.normal(0, noise * quantum, (angles, n)) if noise else np.zeros((angles, n))
    read = np.round((true[:, None] + own) / quantum) * quantum
    rounding = np.std(read.mean(1) - true - own.mean(1))
    stated = InclinometerErrors(noise_rad=max(noise, 1e-9) * quantum, quantum_rad=quantum)
    claimed = stated.undithered_rad(
        Tilt(0.1, 0.1, np.eye(2) * (noise * quantum) ** 2 / n, utc_unix_s=UTC, samples=n)
    )
    # a reading's rounding is noise too, of a share sqrt(1 / 12 n) of a step, which the scatter of the readings shows
    floor = quantum / np.sqrt(12 * n)
    assert rounding < 1.1 * np.hypot(claimed, floor)
    if noise < 0.4:
        assert rounding > 0.7 * claimed


def test_rounding_errs_by_the_same_as_long_as_it_stands_on_a_step():
    errors = InclinometerErrors(quantum_rad=1e-5)

    def at(x, y):
        return errors.steps(Tilt(x, y, np.eye(2) * 1e-12, utc_unix_s=UTC))

    assert at(1.04e-5, -2.0e-5) == at(0.96e-5, -2.4e-5)
    assert at(1.04e-5, 0) != at(1.6e-5, 0)
    assert replace(errors, quantum_rad=0.0).steps(Tilt(0.1, 0.1, np.eye(2), utc_unix_s=UTC)) == ()
    assert (
        replace(errors, quantum_rad=0.0).undithered_rad(Tilt(0.1, 0.1, np.eye(2) * 1e-12, utc_unix_s=UTC))
        == 0
    )

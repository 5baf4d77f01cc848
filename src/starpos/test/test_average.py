# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest
from fields import ARCSEC, UTC, Field, random_field, turn

from starpos import rotation
from starpos.average import average
from starpos.earth import curvature_radii_m, earth_state
from starpos.errors import FixError
from starpos.inclinometer import Tilt

STATE = earth_state(UTC)


def fixes(field, rng, headings, tilt=12.6, calibration=0.0, slip=None):
    """Fixes at these azimuths: tilt noise in arcsec new in each, one slip of the mount (arcsec about S's axes) in all."""
    slip = rotation.from_vector(
        rng.normal(0, calibration * ARCSEC, 3) if slip is None else np.array(slip) * ARCSEC
    )
    made = []
    for azimuth in headings:
        here = replace(field, azimuth=azimuth)
        up = slip @ here.a3 @ here.attitude[2]
        reading = np.arcsin(up[:2]) + rng.normal(0, tilt * ARCSEC, 2)
        xy, places = here.places(STATE, rng)
        made.append(here.solve(
            xy + rng.normal(0, 0.05, xy.shape), places, STATE,
            tilt=Tilt(*reading, np.eye(2) * (tilt * ARCSEC) ** 2, UTC), mounting=here.mounting(calibration),
        ))  # fmt: skip
    return made


def moved_m(a, field):
    """East, north in m: found minus true."""
    prime, meridian = curvature_radii_m(np.radians(field.latitude))
    east = turn(a.longitude - np.radians(field.longitude)) * prime * np.cos(np.radians(field.latitude))
    return np.array([east, (a.latitude - np.radians(field.latitude)) * meridian])


def sigmas(a, name=None):
    return np.sqrt(np.diag(sum(t.covariance for t in a.terms if name in (None, t.name)))[:3])


def test_one_fix_is_its_own_average(rng):
    (only,) = fixes(Field(), rng, [40.0])
    a = average([only])
    assert (a.latitude, a.longitude, a.heading, a.utc_unix_s) == pytest.approx(
        (only.latitude, only.longitude, only.heading, UTC), abs=1e-15
    )
    np.testing.assert_allclose(a.covariance, only.covariance, rtol=1e-6, atol=1e-16)
    assert a.frames == 1


def test_noise_averages_and_what_is_common_stays(rng):
    made = fixes(Field(), rng, [40.0] * 16, calibration=20.0)
    a = average(made)
    assert sigmas(a, "tilt") == pytest.approx(sigmas(made[0], "tilt") / 4, rel=0.02)
    each = np.array([sigmas(f, "centroids") for f in made])
    # the small terms pay where that lowers the large one
    assert np.all(sigmas(a, "centroids") < 2.5 * np.sqrt(np.mean(each**2, 0)) / 4)
    assert sigmas(a, "calibration") == pytest.approx(sigmas(made[0], "calibration"), rel=0.02)


def test_half_a_turn_takes_the_calibration_off_the_position(rng):
    """Level: a slip of the mount moves the fix with the instrument, so that opposite headings cancel it."""
    field = Field(altitude=89.0)
    a = average(
        fixes(field, rng, [10.0, 100.0, 190.0, 280.0], tilt=0.1, calibration=60.0, slip=(50.0, -30.0, 0.0))
    )
    assert np.all(np.abs(moved_m(a, field)) < 60)  # a single one is 1.5 km off
    assert np.all(sigmas(a, "calibration")[:2] < 60)


@pytest.mark.parametrize("calibration", [0.0, 15.0])
def test_an_average_errs_as_its_covariance_says(calibration, rng):
    position, heading = [], []
    for _ in range(60):
        field = random_field(rng, altitude=85.0, latitude=rng.uniform(-70, 70), stars=15)
        a = average(fixes(field, rng, [field.azimuth] * 4, calibration=calibration))
        m = moved_m(a, field)
        position.append(m @ np.linalg.solve(a.covariance[:2, :2], m))
        heading.append(turn(a.heading - field.heading) ** 2 / a.covariance[2, 2])
    assert np.mean(position) / 2 == pytest.approx(1, abs=4 / np.sqrt(60))
    assert np.mean(heading) == pytest.approx(1, abs=4 * np.sqrt(2 / 60))


def test_an_instrument_that_turned_has_no_heading(rng):
    a = average(fixes(Field(), rng, [10.0, 12.0]))
    assert np.isnan(a.heading)
    assert np.isnan(a.covariance[2]).all()
    assert np.isfinite(a.covariance[:2, :2]).all()
    assert np.isfinite([a.latitude, a.longitude]).all()


def test_over_the_date_line_and_over_north(rng):
    field = replace(Field(), longitude=180.0, azimuth=0.0, altitude=75.0, roll=180.0)
    a = average(fixes(field, rng, [0.0] * 8))
    assert np.all(np.abs(moved_m(a, field)) < 4 * sigmas(a)[:2])
    assert -np.pi <= a.longitude < np.pi
    assert abs(turn(a.heading)) < 5 * sigmas(a)[2]
    assert 0 <= a.heading < 2 * np.pi


def test_a_better_frame_counts_more(rng):
    field = Field()
    poor, good = fixes(field, rng, [40.0], tilt=100.0), fixes(field, rng, [40.0], tilt=1.0)
    a = average(poor + good)
    assert np.all(np.abs(moved_m(a, field) - moved_m(good[0], field)) < 10)
    assert sigmas(a, "tilt")[:2] == pytest.approx(sigmas(good[0], "tilt")[:2], rel=0.01)


def test_frames_of_two_places_are_not_averaged(rng):
    here, there = Field(), replace(Field(), latitude=Field().latitude + 0.5)
    with pytest.raises(FixError, match="not of one place"):
        average(fixes(here, rng, [40.0] * 3) + fixes(there, rng, [40.0] * 3))


def test_the_same_frame_given_twice_counts_once(rng):
    made = fixes(Field(), rng, [40.0] * 3)
    once, twice = average(made), average(made + made)
    assert twice.frames == once.frames == 3
    np.testing.assert_array_equal(once.covariance, twice.covariance)


def test_frames_that_share_a_tilt_reading_share_its_error(rng):
    """One reading served four frames: its noise does not average."""
    field = Field()
    made = [replace(f, tilt_times=(UTC,)) for f in fixes(field, rng, [40.0], tilt=12.6) for _ in range(4)]
    made = [replace(f, utc_unix_s=UTC + k) for k, f in enumerate(made)]
    assert sigmas(average(made), "tilt") == pytest.approx(sigmas(made[0], "tilt"), rel=1e-3)
    apart = [replace(f, tilt_times=(UTC + k,)) for k, f in enumerate(made)]
    assert sigmas(average(apart), "tilt") == pytest.approx(sigmas(made[0], "tilt") / 2, rel=1e-3)


@pytest.mark.parametrize("latitude", [89.9, 89.999, -90.0])
def test_near_a_pole_a_common_error_does_not_average_away(latitude, rng):
    field = replace(Field(), latitude=latitude)
    made = fixes(field, rng, [40.0] * 10, calibration=5.0)
    assert sigmas(average(made), "calibration")[:2] == pytest.approx(
        sigmas(made[0], "calibration")[:2], rel=0.05
    )


def test_a_thousand_frames(rng):
    made = fixes(Field(), rng, [40.0] * 2)
    many = [replace(made[k % 2], utc_unix_s=UTC + k) for k in range(1000)]
    assert sigmas(average(many), "tilt") == pytest.approx(sigmas(made[0], "tilt") / np.sqrt(1000), rel=0.02)

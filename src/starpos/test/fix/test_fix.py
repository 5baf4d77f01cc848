# SPDX-License-Identifier: Apache-2.0
"""A4 and its covariance on fields whose truth is known."""

from dataclasses import replace

import numpy as np
import pytest

from starpos import rotation
from starpos.earth.ellipsoid import curvature_radii_m
from starpos.earth.orientation import earth_state
from starpos.earth.refraction import Atmosphere
from starpos.errors import FixError
from starpos.instrument.camera import Camera
from starpos.instrument.inclinometer import Tilt
from starpos.units import ARCSEC
from starpos_testing.skies.fields import PAPER, UTC, SkyField, random_field

STATE = earth_state(UTC)
PLACES = {
    "anywhere": {},
    "near the zenith": {"altitude": 90.0},
    "a hair off the zenith": {"altitude": 89.9999},
    "north pole": {"latitude": 89.99},
    "south pole": {"latitude": -89.99},
    "date line": {"longitude": 180.0},
    "equator": {"latitude": 0.0},
    "leaning far": {"altitude": 61.5, "misalignment": (0.0, 0.0, 0.0)},
}


def error_arcsec(fix, field):
    """North, east, heading: found minus true."""
    phi = np.radians(field.latitude)
    east = rotation.half_turn(fix.longitude - np.radians(field.longitude)) * np.cos(phi)
    return np.array([fix.latitude - phi, east, rotation.half_turn(fix.heading - field.heading)]) / ARCSEC


@pytest.mark.parametrize("where", PLACES)
def test_a_field_without_errors_gives_back_its_place(where, rng):
    for _ in range(6):
        field = random_field(rng, **PLACES[where])
        xy, places = field.places(STATE, rng)
        north, east, heading = error_arcsec(field.solve(xy, places, STATE), field)
        assert abs(north) < 1e-6
        assert abs(east) < 1e-6
        # heading is worth less where north itself is: near a pole
        assert abs(heading) < 1e-6 / min(1.0, np.cos(np.radians(field.latitude)) * 10) + 1e-6


def test_what_a_fix_reports(rng):
    field = SkyField(altitude=90.0, stars=60)
    xy, places = field.places(STATE, rng)
    fix = field.solve(xy, places, STATE)
    assert fix.utc_unix_s == UTC
    assert fix.used.tolist() == list(range(60))
    assert fix.residual_arcsec < 1e-5
    assert fix.jitter_px < 1e-4
    assert fix.focal_scale == pytest.approx(1, abs=1e-10)
    assert fix.zenith_distance == pytest.approx(0, abs=1e-7)
    assert fix.refraction_arcsec == pytest.approx(0, abs=1e-4)
    assert fix.diurnal_aberration_arcsec == pytest.approx(0.32 * np.cos(np.radians(35.7)), abs=0.001)
    assert fix.ut1_minus_utc_s == STATE.orientation.ut1_minus_utc_s
    np.testing.assert_allclose(fix.link_to_enu @ fix.link_to_enu.T, np.eye(3), atol=1e-14)


def test_the_attitude_is_that_of_the_link(rng):
    """x of the link is the top of the frame unless it is mounted otherwise; a turned mount turns heading and attitude."""
    field = random_field(rng)
    xy, places = field.places(STATE, rng)
    plain = field.solve(xy, places, STATE)
    np.testing.assert_allclose(plain.link_to_enu[:, 2], field.attitude[:, 2], atol=1e-10)
    np.testing.assert_allclose(plain.link_to_enu[:, 0], -field.attitude[:, 1], atol=1e-10)
    link = rotation.from_vector(rng.normal(size=3))
    turned = field.solve(
        xy,
        places,
        STATE,
        instrument=replace(field.instrument(), link_to_camera=link),
    )
    np.testing.assert_allclose(turned.link_to_enu, field.attitude @ link, atol=1e-10)
    forward = turned.link_to_enu[:, 0]
    assert rotation.half_turn(turned.heading - np.arctan2(forward[0], forward[1])) == pytest.approx(
        0, abs=1e-12
    )


@pytest.mark.parametrize("azimuth", [0.0, 1e-9, -1e-9, 90.0, 180.0, 270.0])
def test_heading_is_clockwise_from_north_in_0_to_360(azimuth, rng):
    """A camera at roll 180 with its top away from the zenith faces where it leans."""
    field = SkyField(azimuth=azimuth, altitude=75.0, roll=180.0)
    xy, places = field.places(STATE, rng)
    heading = np.degrees(field.solve(xy, places, STATE).heading)
    assert 0 <= heading < 360
    assert rotation.half_turn(np.radians(heading - azimuth)) / ARCSEC == pytest.approx(0, abs=1e-4)


def test_a_focal_length_a_percent_off_is_found(rng):
    field = random_field(rng)
    xy, places = field.places(STATE, rng)
    fix = field.solve(xy, places, STATE, camera=PAPER.scaled(1.01))
    assert fix.focal_scale == pytest.approx(1 / 1.01, rel=1e-9)
    assert np.all(np.abs(error_arcsec(fix, field)) < 1e-5)


def test_distortion_is_taken_off(rng):
    camera = Camera(
        width=1392,
        height=1040,
        fx=5200.0,
        fy=5200.0,
        cx=700.0,
        cy=520.0,
        distortion=(-0.15, 0.1, 1e-3, -1e-3, 0.0),
    )
    field = random_field(rng, camera=camera)
    xy, places = field.places(STATE, rng)
    assert np.all(np.abs(error_arcsec(field.solve(xy, places, STATE), field)) < 1e-5)


@pytest.mark.parametrize("stars", [12, 40])
def test_an_outlier_does_not_move_it(stars, rng):
    field = random_field(rng, stars=stars)
    xy, places = field.places(STATE, rng)
    xy = xy + rng.normal(0, 0.05, xy.shape)
    without = field.solve(xy[1:], places[1:], STATE)
    moved = xy.copy()
    moved[0] += [30.0, -20.0]
    fix = field.solve(moved, places, STATE)
    assert 0 not in fix.used
    assert np.all(np.abs(error_arcsec(fix, field) - error_arcsec(without, field)) < 1e-3)


def test_scatter_beyond_the_centroids_errors_widens_the_fix(rng):
    field = random_field(rng, stars=80)
    xy, places = field.places(STATE, rng)
    fix = field.solve(xy + rng.normal(0, 0.4, xy.shape), places, STATE)
    assert fix.jitter_px == pytest.approx(0.4, rel=0.2)
    term = {t.name: t for t in fix.terms}["centroids"]
    calm = {t.name: t for t in field.solve(xy, places, STATE).terms}["centroids"]
    ratio = np.sqrt(np.diag(term.covariance)[:3] / np.diag(calm.covariance)[:3])
    assert ratio == pytest.approx(8, rel=0.2)


@pytest.mark.montecarlo
def test_few_stars_do_not_claim_what_they_cannot_tell(rng):
    """Four of unknown scatter: their errors go as Student's t of four, 63 % within the likeliest sigma; 77 within its."""
    within = []
    for k in range(400):
        if k % 10 == 0:
            field = random_field(rng, stars=4, latitude=rng.uniform(-60, 60))
            xy, places = field.places(STATE, rng)
        fix = field.solve(xy + rng.normal(0, 0.5, xy.shape), places, STATE)
        within.append(abs(error_arcsec(fix, field)[2]) * ARCSEC < np.sqrt(fix.covariance[2, 2]))
    assert np.mean(within) == pytest.approx(0.77, abs=0.06)


def test_a_star_of_absurd_errors_tells_nothing_and_spoils_nothing(rng):
    field = random_field(rng, stars=30)
    xy, places = field.places(STATE, rng)
    xy = xy + rng.normal(0, 0.05, xy.shape)
    covariance = np.eye(2)[None].repeat(30, 0) * 0.05**2
    without = field.solve(xy[1:], places[1:], STATE, covariance_px2=covariance[1:])
    covariance[0] *= 1e14
    fix = field.solve(xy, places, STATE, covariance_px2=covariance)
    assert np.all(np.abs(error_arcsec(fix, field) - error_arcsec(without, field)) < 1e-3)
    assert np.sqrt(np.diag(fix.covariance)) == pytest.approx(np.sqrt(np.diag(without.covariance)), rel=0.1)


@pytest.mark.parametrize("sigma_px", [np.inf, np.nan])
def test_a_star_whose_error_is_no_number_is_told(sigma_px, rng):
    field = SkyField(stars=12)
    xy, places = field.places(STATE, rng)
    covariance = np.tile(0.05**2 * np.eye(2), (12, 1, 1))
    covariance[3, 0, 0] = sigma_px**2
    with pytest.raises(FixError, match="not a finite number"):
        field.solve(xy, places, STATE, covariance_px2=covariance)


@pytest.mark.parametrize("sigma_px", [1e-12, 1e-3, 1e3])
def test_a_claim_is_a_number_however_small_or_large_the_errors_are_said_to_be(sigma_px, rng):
    field = SkyField(stars=12)
    xy, places = field.places(STATE, rng)
    fix = field.solve(xy, places, STATE, covariance_px2=np.tile(sigma_px**2 * np.eye(2), (12, 1, 1)))
    assert np.isfinite(fix.covariance).all()


def test_it_does_not_matter_how_covariances_lie_in_memory(rng):
    field = SkyField(stars=12)
    xy, places = field.places(STATE, rng)
    covariance = np.tile([[0.01, 0.002], [0.002, 0.02]], (12, 1, 1))
    usual, other = (
        field.solve(xy, places, STATE, covariance_px2=c) for c in (covariance, np.asfortranarray(covariance))
    )
    assert other.latitude == usual.latitude and np.array_equal(other.covariance, usual.covariance)


@pytest.mark.parametrize("part", ["covariance_px2", "place_sigma"])
def test_stars_whose_arrays_do_not_fit_are_refused(part, rng):
    field = SkyField(stars=12)
    xy, places = field.places(STATE, rng)
    few = {"covariance_px2": 0.01 * np.eye(2)[None], "place_sigma": np.array([1e-8])}[part]
    with pytest.raises(ValueError, match="differ in length or shape"):
        field.solve(xy, places, STATE, **{part: few})


def test_too_few_stars(rng):
    field = SkyField(stars=2)
    xy, places = field.places(STATE, rng)
    with pytest.raises(FixError, match="only 2 of 2"):
        field.solve(xy, places, STATE)


def test_stars_that_agree_on_nothing(rng):
    field = SkyField(stars=30)
    xy, places = field.places(STATE, rng)
    for wrong in (places[::-1], rng.permutation(places)):
        with pytest.raises(FixError):
            field.solve(xy, wrong, STATE)


def drawn(
    field,
    rng,
    centroid=0.0,
    place=0.0,
    tilt=0.0,
    calibration=0.0,
    remounting=0.0,
    clock=0.0,
    stamp=0.0,
    ut1=0.0,
    refraction=0.0,
):
    """A fix whose every error is drawn from its stated sigma: px, four in arcsec, s, s, s, fraction."""
    state = replace(STATE, orientation=replace(STATE.orientation, ut1_sigma_s=ut1, pole_sigma=0.0))
    true = replace(field, utc=field.utc + rng.normal(0, clock) + rng.normal(0, stamp) + rng.normal(0, ut1))
    air = Atmosphere(
        pressure_pa=field.air.pressure_pa,
        temperature_c=field.air.temperature_c,
        humidity=0.3,
        temperature_stddev_c=0.0,
        pressure_stddev_pa=refraction * field.air.pressure_pa,
        humidity_stddev=0.0,
        wavelength_stddev_um=0.0,
    )
    true_air = replace(air, pressure_pa=air.pressure_pa * (1 + rng.normal(0, refraction)))
    # the true mount is the stated one and a little more about the inclinometer's axes
    slip = rotation.from_vector(rng.normal(0, np.hypot(calibration, remounting) * ARCSEC, 3))
    up = slip @ field.a3 @ true.attitude[2]
    reading = np.arcsin(up[:2]) + rng.normal(0, tilt * ARCSEC, 2)
    xy, places = replace(true, air=true_air).places(earth_state(true.utc), rng)
    moved = places + rng.normal(0, place * ARCSEC, places.shape)
    return field.solve(
        xy + rng.normal(0, centroid, xy.shape),
        moved / np.linalg.norm(moved, axis=1, keepdims=True),
        state,
        covariance_px2=np.eye(2)[None].repeat(len(xy), 0) * max(centroid, 1e-4) ** 2,
        place_sigma=np.full(len(xy), place * ARCSEC),
        tilt=Tilt(*reading, np.eye(2) * (tilt * ARCSEC) ** 2, utc_unix_s=field.utc),
        instrument=field.instrument(calibration, remounting),
        atmosphere=air,
        clock_stddev_s=clock,
        stamp_stddev_s=stamp,
    )


SOURCES = {
    "centroids": {"centroid": 0.2},
    "catalogue": {"place": 0.3},
    "tilt": {"tilt": 12.6, "centroid": 0.01},
    "calibration": {"calibration": 20.0, "centroid": 0.01},
    "remounting": {"remounting": 20.0, "centroid": 0.01},
    "refraction": {"refraction": 0.1, "centroid": 0.001},
    "clock": {"clock": 0.5, "centroid": 0.01},
    "time stamp": {"stamp": 0.5, "centroid": 0.01},
    "ut1": {"ut1": 0.1, "centroid": 0.01},
    "all": {
        "centroid": 0.1,
        "place": 0.1,
        "tilt": 5.0,
        "calibration": 5.0,
        "refraction": 0.1,
        "clock": 0.3,
        "stamp": 0.2,
        "ut1": 0.1,
    },
}


@pytest.mark.montecarlo
@pytest.mark.parametrize("source", SOURCES)
def test_errors_are_as_large_as_their_covariance_says(source, rng):
    """Each error drawn from its sigma: chi-squares of position, heading and attitude average to their freedom."""
    drawn_from, tries = SOURCES[source], 120
    position, heading, attitude, together = [], [], [], []
    for _ in range(tries):
        field = random_field(rng, stars=25, altitude=rng.uniform(65, 85), latitude=rng.uniform(-75, 75))
        fix = drawn(field, rng, **drawn_from)
        prime, meridian = curvature_radii_m(np.radians(field.latitude))
        north, east, turned = error_arcsec(fix, field) * ARCSEC
        moved = np.array([east * prime, north * meridian])
        c = fix.covariance
        position.append(moved @ np.linalg.solve(c[:2, :2], moved))
        heading.append(turned**2 / c[2, 2])
        # They are of like size.
        unit = np.array([1.0, 1.0, ARCSEC / 30])
        all_three = np.array([*moved, turned]) / unit
        together.append(all_three @ np.linalg.solve(c / np.outer(unit, unit), all_three))
        spin = rotation.to_small_vector(
            fix.link_to_enu @ (field.attitude @ np.array(field.instrument().link_to_camera)).T
        )
        attitude.append(np.sum(spin**2) / np.trace(fix.link.covariance))
    bound = 4 * np.sqrt(2 / tries)
    # With what they have in common.
    assert np.mean(together) / 3 == pytest.approx(1, abs=bound / np.sqrt(3))
    assert np.mean(position) / 2 == pytest.approx(1, abs=bound / np.sqrt(2))
    # These turn the Earth: heading and attitude do not mind.
    if source not in ("clock", "time stamp", "ut1"):
        assert np.mean(heading) == pytest.approx(1, abs=bound)
        assert np.mean(attitude) == pytest.approx(1, abs=bound)


def test_the_tilts_error_is_the_positions(rng):
    """1 arcsec of tilt is 30.9 m; with the paper's 12.6 arcsec a single reading gives 390 m a axis."""
    field = SkyField(altitude=88.0)
    xy, places = field.places(STATE, rng)
    fix = field.solve(xy, places, STATE, tilt=field.tilt(np.eye(2) * ARCSEC**2))
    term = {t.name: t for t in fix.terms}["tilt"]
    assert np.sqrt(np.diag(term.covariance)[:2]) == pytest.approx([30.95, 30.8], abs=0.15)


def test_a_second_of_time_is_464_metres_at_the_equator(rng):
    field = SkyField(latitude=0.0)
    xy, places = field.places(STATE, rng)
    terms = {t.name: t for t in field.solve(xy, places, STATE, clock_stddev_s=1.0).terms}
    assert np.sqrt(terms["clock"].covariance[0, 0]) == pytest.approx(465, abs=1)
    assert terms["clock"].covariance[1, 1] < 1e-20


def test_the_budget_says_which_errors_are_common(rng):
    field = SkyField()
    xy, places = field.places(STATE, rng)
    common = {t.name: t.common for t in field.solve(xy, places, STATE).terms}
    new = {"centroids", "tilt", "tilt quantisation", "tilt pose"}
    assert {name for name, is_common in common.items() if not is_common} == new
    assert set(common) - new == {
        "catalogue",
        "calibration",
        "remounting",
        "tilt drift",
        "tilt temperature",
        "tilt response",
        "refraction",
        "shutter",
        "clock",
        "time stamp",
        "ut1",
        "pole",
    }

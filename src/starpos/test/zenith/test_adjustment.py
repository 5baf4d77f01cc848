# SPDX-License-Identifier: Apache-2.0
"""The adjustment of a zenith camera's session: its value, and the truth of its covariance."""

from dataclasses import replace

import numpy as np
import pytest
from sessions import INSTRUMENT, MARK, VACUUM, drawn

from starpos import rotation
from starpos.earth.ellipsoid import enu_axes
from starpos.earth.refraction import Atmosphere
from starpos.errors import FixError
from starpos.units import ARCSEC
from starpos.zenith.adjustment import adjusted
from starpos.zenith.equations import LeanEstimate
from starpos.zenith.sighting import faces_of


@pytest.mark.parametrize("turn_deg", [0.0, 94.0, 180.0, 271.0])
def test_without_noise_the_deflection_comes_back_however_the_tiltmeter_faces(rng, turn_deg):
    session = drawn(rng, motion=0.0, air=0.0, turn_deg=turn_deg, frames=2)
    found = session.adjusted()
    assert [found.xi_arcsec, found.eta_arcsec] == pytest.approx([session.xi, session.eta], abs=2e-4)


def test_claimed_errors_are_true(rng):
    nees = []
    for _ in range(20):
        session = drawn(rng, frames=4)
        found = session.adjusted()
        error = np.array([found.xi_arcsec - session.xi, found.eta_arcsec - session.eta])
        nees.append(error @ np.linalg.solve(found.covariance_arcsec2, error))
    assert 1.2 < np.mean(nees) < 2.8


def test_the_covariance_is_the_sum_of_its_sources(rng):
    found = drawn(rng, frames=3).adjusted()
    terms = [
        np.outer(sizes, sizes) * [[1, found.correlations[name]], [found.correlations[name], 1]]
        for name, *sizes in found.terms
    ]
    assert np.sum(terms, axis=0) == pytest.approx(found.covariance_arcsec2, rel=1e-6, abs=1e-9)


def test_the_size_of_the_image_motion_comes_from_the_frames_own_scatter(rng):
    calm, restless = (drawn(rng, motion=m, air=m / 8).adjusted() for m in (0.05, 0.8))
    assert [np.degrees(a.air.motion) * 3600 for a in (calm, restless)] == pytest.approx([0.05, 0.8], rel=0.35)
    assert calm.sigma_arcsec.max() < restless.sigma_arcsec.min() / 4


def test_more_faces_do_not_average_what_their_air_shares(rng):
    short, long = (drawn(rng, azimuths=(0, 90, 180, 270) * n).adjusted() for n in (1, 2))
    assert long.sigma_arcsec.max() > 0.75 * short.sigma_arcsec.min()


def test_faces_are_runs_of_one_heading(rng):
    sightings = drawn(rng, azimuths=(350, 5, 350), frames=2).sightings
    assert faces_of(sightings).tolist() == [0, 0, 1, 1, 2, 2]


def test_eta_is_the_difference_of_longitudes_where_meridians_converge():
    latitude, (xi, eta) = np.radians(80.0), np.array([20.0, 25.0]) * ARCSEC
    up, place = enu_axes(latitude + xi, eta / np.cos(latitude))[2], enu_axes(latitude, 0.0)
    east, north, height = place @ up
    lean = LeanEstimate(lean=np.array([north, east]) / height, a3=np.eye(3))
    assert lean.deflection(latitude) / ARCSEC == pytest.approx([20.0, 25.0], abs=1e-6)
    assert abs(lean.lean[1] - eta) / ARCSEC > 0.01


def test_layers_of_air_lie_along_the_plumb_line(rng):
    # Laplace's formula fitted to the Pulkovo tables: 57.085 arcsec tan z in dry air, 15 C, 1013.25 hPa, 0.59 um
    air = Atmosphere(pressure_pa=101_325.0, temperature_c=15.0, humidity=0.0, wavelength_um=0.59)
    sightings = drawn(rng, motion=0.0, air=0.0, frames=2).sightings
    bent, straight = (adjusted(sightings, INSTRUMENT, a, MARK) for a in (air, VACUUM))
    size = [np.hypot(a.xi_arcsec, a.eta_arcsec) for a in (bent, straight)]
    assert (size[0] / size[1] - 1) / ARCSEC == pytest.approx(57.085, rel=0.01)


def test_daily_terms_of_the_pole_and_of_ut1_are_in_the_covariance(rng):
    terms = {name: (xi, eta) for name, xi, eta in drawn(rng, frames=2).adjusted().terms}
    assert terms["pole"] == pytest.approx([3e-4, 3e-4 * np.sin(MARK.latitude)], rel=0.05)
    assert terms["ut1"][1] == pytest.approx(15.041 * 3e-5 * np.cos(MARK.latitude), rel=0.1)


NO_SESSION = {
    "two faces close to each other": lambda rng: drawn(rng, azimuths=(0, 20), frames=4).sightings,
    "attitudes that scatter by degrees": lambda rng: [
        scattered(rng, s) for s in drawn(rng, frames=3).sightings
    ],
    "readings that state no noise": lambda rng: [silent(s) for s in drawn(rng, frames=3).sightings],
}


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("kind", NO_SESSION)
def test_equations_that_do_not_settle_are_an_error_and_no_value(kind, seed):
    sightings = NO_SESSION[kind](np.random.default_rng(seed))
    with pytest.raises(FixError, match=r"do not come round|does not settle|no solution"):
        adjusted(sightings, INSTRUMENT, VACUUM, MARK)


def scattered(rng, sighting):
    return sighting.turned(rotation.from_vector(rng.normal(0, 0.1, 3)))


def silent(sighting):
    return replace(sighting, tilt=replace(sighting.tilt, covariance=np.zeros((2, 2))))


def test_two_frames_are_no_session(rng):
    with pytest.raises(FixError, match="at least 3"):
        adjusted(drawn(rng).sightings[:2], INSTRUMENT, VACUUM, MARK)

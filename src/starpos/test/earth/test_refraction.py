# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import erfa
import numpy as np
import pytest

from starpos.earth.refraction import LOW, Atmosphere, Refraction
from starpos.errors import InstrumentError
from starpos.units import ARCSEC


def at_zenith_distance(degrees):
    z = np.radians(np.atleast_1d(degrees))
    return np.stack([np.sin(z), np.zeros_like(z), np.cos(z)], -1)


def lifted_arcsec(refraction, degrees):
    """How far a star at an unrefracted zenith distance is raised."""
    v = at_zenith_distance(degrees)
    u = refraction.bend(v)
    return np.degrees(np.arctan2(v[:, 0], v[:, 2]) - np.arctan2(u[:, 0], u[:, 2])) * 3600


def test_constants_are_those_of_erfas_test_suite():
    """t_refco of ERFA's test suite: 800 hPa, 10 deg C, humidity 0.9, 0.4 um."""
    r = Atmosphere(pressure_pa=80000.0, temperature_c=10.0, humidity=0.9, wavelength_um=0.4).refraction()
    assert r.a == pytest.approx(0.2264949956241415009e-3, abs=1e-15)
    assert r.b == pytest.approx(-0.2598658261729343970e-6, abs=1e-18)


def test_bend_is_erfas():
    """eraAtioq on a context with no diurnal aberration: the same bending but for its cos(d) = 1 - d^2 / 2."""
    air = Atmosphere(pressure_pa=101325.0, temperature_c=15.0, humidity=0.5)
    a = erfa.apio(0.0, 0.0, 0.0, np.pi / 2, 0.0, 0.0, 0.0, *erfa.refco(1013.25, 15.0, 0.5, 0.55))
    z = np.array([0.1, 10, 45, 70, 80, 86])
    zob = erfa.atioq(np.zeros(6), np.pi / 2 - np.radians(z), a)[1]
    assert lifted_arcsec(air.refraction(), z) == pytest.approx(
        z * 3600 - np.degrees(zob) * 3600, rel=2e-6, abs=2e-6
    )


def test_standard_refraction():
    """Explanatory Supplement: 58.3 arcsec times tan z at 1010 hPa, 10 deg C and 45 deg, about 10 arcmin at 85 deg."""
    r = Atmosphere(pressure_pa=101000.0, temperature_c=10.0, humidity=0.0).refraction()
    assert lifted_arcsec(r, 45) == pytest.approx(58.2, abs=0.4)
    assert lifted_arcsec(r, 80) == pytest.approx(316, abs=4)


def test_unbend_is_the_inverse_of_bend(rng):
    """To what ERFA's single Newton step leaves."""
    r = Atmosphere().refraction()
    v = rng.normal(size=(2000, 3))
    v /= np.linalg.norm(v, axis=1, keepdims=True)
    for limit, tolerance in ((45, 1e-5), (70, 1e-3), (80, 0.02)):
        high = v[v[:, 2] > np.cos(np.radians(limit))]
        error = np.linalg.norm(r.unbend(r.bend(high)) - high, axis=1)
        assert error.max() < tolerance * ARCSEC


def test_stars_stay_on_their_vertical_and_unit(rng):
    v = rng.normal(size=(1000, 3))
    v /= np.linalg.norm(v, axis=1, keepdims=True)
    for u in (Atmosphere().refraction().bend(v), Atmosphere().refraction().unbend(v)):
        np.testing.assert_allclose(np.linalg.norm(u, axis=1), 1, atol=1e-14)
        np.testing.assert_allclose(np.arctan2(u[:, 1], u[:, 0]), np.arctan2(v[:, 1], v[:, 0]), atol=1e-13)


def test_zenith_and_horizon_and_below_give_numbers():
    v = np.array([[0, 0, 1.0], [1, 0, 0], [0.6, 0, -0.8], [0, 0, -1]])
    u = Atmosphere().refraction().bend(v)
    assert np.isfinite(u).all()
    assert u[0] == pytest.approx(v[0], abs=1e-12)
    assert u[1, 2] > 0


def test_no_air_no_refraction(rng):
    v = at_zenith_distance(rng.uniform(0, 90, 20))
    assert Atmosphere(pressure_pa=0.0).refraction().bend(v) == pytest.approx(v, abs=1e-15)
    assert Atmosphere(pressure_pa=0.0).relative_sigma == 0


def test_sigma_follows_what_was_measured():
    """Refraction goes with pressure and the inverse of absolute temperature."""
    known = Atmosphere(
        pressure_pa=100_000.0, temperature_c=0.0, humidity_stddev=0.0, wavelength_stddev_um=0.0
    )
    assert known.relative_sigma == pytest.approx(np.hypot(200 / 1e5, 2 / 273.15))
    known = Atmosphere.measured(100_000.0, 0.0)
    # of the light that the camera sees, the 0.47 to 0.63 um in which filters lie
    light = [replace(known, wavelength_um=known.wavelength_um + s).refraction().a for s in (0.08, -0.08)]
    light = (light[1] - light[0]) / 2 / known.refraction().a
    assert known.relative_sigma == pytest.approx(np.hypot(light, np.hypot(200 / 1e5, 2 / 273.15)), rel=0.1)
    guessed = Atmosphere.measured(None, None)
    assert guessed.relative_sigma > 20 * known.relative_sigma / 2
    # The air at 3000 m, and of a hot day by the sea.
    for pressure, temperature in ((70_000, -5), (101_300, 30)):
        true = Atmosphere(pressure_pa=pressure, temperature_c=temperature).refraction().a
        assert abs(guessed.refraction().a / true - 1) < 3 * guessed.relative_sigma
    numerical = (
        Atmosphere(pressure_pa=100_200.0, temperature_c=0.0).refraction().a
        / Atmosphere(pressure_pa=100_000.0, temperature_c=0.0).refraction().a
        - 1
    )
    assert numerical == pytest.approx(200 / 1e5, rel=0.01)


def test_a_factor_scales_the_bending():
    one, half = Atmosphere().refraction(), Atmosphere().refraction(0.5)
    assert (half.a, half.b) == (one.a / 2, one.b / 2)
    assert isinstance(half, Refraction)


@pytest.mark.parametrize(
    ("name", "value"),
    [("pressure_pa", -1.0), ("pressure_pa", 1013.25e3), ("pressure_pa", 880.0), ("pressure_pa", float("inf")),
     ("temperature_c", -274.0), ("temperature_c", 283.15), ("humidity", 30.0),
     ("wavelength_um", 550.0), ("pressure_pa", float("nan")), ("temperature_c", float("inf"))],
)  # fmt: skip
def test_impossible_air_is_refused_with_its_limits(name, value):
    with pytest.raises(InstrumentError, match=r"must lie between .* and"):
        Atmosphere(**{name: value})


def test_a_pressure_in_the_wrong_unit_is_named_in_both():
    with pytest.raises(
        InstrumentError, match=r"pressure 880 Pa \(8.8 hPa\): .* 30000 and 120000 Pa \(300 and 1200 hPa"
    ):
        Atmosphere(pressure_pa=880.0)
    assert Atmosphere(pressure_pa=30_000.0).relative_sigma > 0


def test_down_to_the_horizon_a_body_is_raised_as_almanacs_have_it():
    """34.5 arcmin for 1010 hPa and 10 deg C (Explanatory Supplement 1992, 9.33); no step where the models meet."""
    air = Atmosphere(pressure_pa=101_000.0, temperature_c=10.0)
    set_deg = -34.5 / 60
    bent, sigma = air.raised(np.array([0.0, np.cos(np.radians(set_deg)), np.sin(np.radians(set_deg))]))
    assert abs(np.degrees(np.arcsin(bent[2]))) < 1.5 / 60
    assert np.radians(0.1) < sigma < np.radians(0.3)
    above, below = (
        air.raised(np.array([np.sqrt(1 - s * s), 0.0, s])) for s in (np.sin(LOW) + 1e-9, np.sin(LOW) - 1e-9)
    )
    assert np.linalg.norm(above[0] - below[0]) < np.radians(0.01 / 60)
    assert below[1] > above[1]

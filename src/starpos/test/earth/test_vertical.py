# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from starpos.earth.ellipsoid import curvature_radii_m, enu_axes, zenith_of
from starpos.earth.vertical import UNKNOWN_HEIGHT_M, AtHeight, Deflection, astronomic, geodetic
from starpos.errors import InstrumentError
from starpos.units import ARCSEC

NONE = np.zeros((3, 3))


def test_signs_by_hand():
    """phi = Phi - xi, lambda = Lambda - eta / cos(phi), azimuth = A - eta tan(phi); here phi 60 deg."""
    g = geodetic(np.radians(60.0), np.radians(10.0), np.radians(30.0), NONE, Deflection(10.0, 6.0, 0.0))
    assert (g.latitude - np.radians(60)) / ARCSEC == pytest.approx(-10, abs=0.001)
    assert (g.longitude - np.radians(10)) / ARCSEC == pytest.approx(-12, abs=0.01)
    assert (g.heading - np.radians(30)) / ARCSEC == pytest.approx(-6 * np.sqrt(3), abs=0.01)
    south = geodetic(np.radians(-60.0), 0.0, 1.0, NONE, Deflection(10.0, 6.0, 0.0))
    assert (south.latitude + np.radians(60)) / ARCSEC == pytest.approx(-10, abs=0.001)
    assert (south.heading - 1.0) / ARCSEC == pytest.approx(6 * np.sqrt(3), abs=0.01)


def test_against_vectors():
    """The gravity vertical leans from the ellipsoid's by xi to the north and eta to the east."""
    phi, lam, xi, eta = 0.8, -2.0, 8 * ARCSEC, -11 * ARCSEC
    east = np.array([-np.sin(lam), np.cos(lam), 0])
    up = np.array([np.cos(phi) * np.cos(lam), np.cos(phi) * np.sin(lam), np.sin(phi)])
    plumb = up + xi * np.cross(up, east) + eta * east
    astronomic = np.arctan2(plumb[2], np.hypot(*plumb[:2])), np.arctan2(plumb[1], plumb[0])
    g = geodetic(*astronomic, 0.0, NONE, Deflection(xi / ARCSEC, eta / ARCSEC, 0.0))
    assert (g.latitude, g.longitude) == pytest.approx((phi, lam), abs=1e-3 * ARCSEC)


def test_an_unknown_deflection_widens_position_and_heading():
    """6 arcsec are 185 m; of the heading eta tan(phi)."""
    g = geodetic(np.radians(45.0), 0.0, 0.0, NONE, Deflection())
    assert np.sqrt(np.diag(g.covariance)) == pytest.approx([185.8, 185.0, 6 * ARCSEC], rel=2e-3)
    # East and clockwise go together: both are minus eta.
    assert g.covariance[0, 2] > 0
    assert g.covariance[1, 2] == g.covariance[0, 1] == 0
    np.testing.assert_allclose(g.covariance, g.deflection_covariance, rtol=1e-12)
    before = np.diag([4.0, 9.0, 1e-10])
    exact = geodetic(0.5, 0.0, 0.0, before, Deflection(1.0, 1.0, 0.0))
    np.testing.assert_allclose(exact.covariance, before, rtol=1e-4, atol=1e-4)
    assert not exact.deflection_covariance.any()


def test_a_heading_that_is_none_stays_none():
    covariance = np.diag([1.0, 1.0, np.nan])
    g = geodetic(0.5, 1.0, float("nan"), covariance, Deflection())
    assert np.isnan(g.heading)
    assert np.isfinite(g.covariance[:2, :2]).all()


def test_ranges_are_kept_over_the_date_line_and_north():
    g = geodetic(0.5, -np.pi, 0.0, NONE, Deflection(0.0, 5.0, 0.0))
    assert g.longitude == pytest.approx(np.pi, abs=1e-4)
    assert 2 * np.pi - 1e-4 < g.heading < 2 * np.pi


POLES = [89.9, 89.9999, 90.0, -89.9999, -90.0]


@pytest.mark.parametrize("latitude", [*POLES, 47.0])
def test_zenith_and_north_turn_by_the_deflection_at_a_pole_as_anywhere(latitude):
    """Both are the astronomic ones turned by xi about west and by eta about north, by scipy's rotations."""
    phi, lam, heading, xi, eta = np.radians(latitude), 1.0, 0.5, 10.0, -7.0
    g = geodetic(phi, lam, heading, NONE, Deflection(xi, eta, 0.0))
    east, north, up = enu_axes(phi, lam)
    turned = Rotation.from_rotvec(ARCSEC * (xi * east - eta * north)).as_matrix()
    np.testing.assert_allclose(zenith_of(g.latitude, g.longitude), turned @ up, atol=1e-15)
    forward = turned @ (np.sin(heading) * east + np.cos(heading) * north)
    here = enu_axes(g.latitude, g.longitude)
    there = np.sin(g.heading) * here[0] + np.cos(g.heading) * here[1]
    np.testing.assert_allclose(there, forward, atol=1e-10)


@pytest.mark.parametrize("latitude", POLES)
def test_the_covariance_at_a_pole_is_that_of_places_drawn_from_it(latitude, rng):
    """East and north of the geodetic place may be any directions of the astronomic one."""
    phi, lam, d = np.radians(latitude), 1.0, Deflection(10.0, -7.0, 0.0)
    covariance = np.array([[400.0, 150.0, 0.0], [150.0, 900.0, 0.0], [0.0, 0.0, 1e-8]])
    g = geodetic(phi, lam, 0.5, covariance, d)
    radius = curvature_radii_m(phi)[0]
    leaned = Rotation.from_rotvec(ARCSEC * np.array([10.0, 7.0, 0.0]) @ enu_axes(phi, lam))
    drawn = rng.multivariate_normal([0, 0], covariance[:2, :2], 4000) / radius
    zeniths = leaned.apply(zenith_of(phi, lam) + drawn @ enu_axes(phi, lam)[:2])
    off = (zeniths - zenith_of(g.latitude, g.longitude)) @ enu_axes(g.latitude, g.longitude)[:2].T * radius
    np.testing.assert_allclose(np.cov(off.T), g.covariance[:2, :2], atol=90)
    assert np.isfinite(g.covariance).all()
    assert np.linalg.eigvalsh(g.covariance[:2, :2]) == pytest.approx(np.linalg.eigvalsh(covariance[:2, :2]))
    unknown = geodetic(phi, lam, 0.5, covariance, Deflection())
    assert np.sqrt(np.diag(unknown.deflection_covariance)[:2]) == pytest.approx(
        [6 * ARCSEC * radius] * 2, rel=1e-6
    )


@pytest.mark.parametrize("latitude", [*POLES, 60.0, 0.0])
def test_the_astronomic_place_of_a_geodetic_one_is_finite_and_as_far_off_as_the_deflection(latitude):
    phi, d = np.radians(latitude), Deflection(3.0, 4.0)
    there = zenith_of(*astronomic(phi, 2.0, d))
    off = enu_axes(phi, 2.0)[:2] @ there / ARCSEC
    assert off == pytest.approx([4.0, 3.0], abs=1e-6)
    if abs(latitude) < 89:
        back = geodetic(*astronomic(phi, 2.0, d), 0.0, NONE, d)
        assert (back.latitude, back.longitude) == pytest.approx((phi, 2.0), abs=1e-3 * ARCSEC)


GM, OMEGA, EQUATOR, FLATTENING = 3.986004418e14, 7.292115e-5, 6378137.0, 1 / 298.257223563


def normal_potential(place):
    """Normal gravity potential of WGS 84 at (x, z) m, by its closed formula (Heiskanen and Moritz, 2-62)."""
    x, z = place
    polar = EQUATOR * (1 - FLATTENING)
    e2 = EQUATOR**2 - polar**2
    far2 = x * x + z * z - e2
    u2 = far2 / 2 * (1 + np.sqrt(1 + 4 * e2 * z * z / far2**2))
    u, e = np.sqrt(u2), np.sqrt(e2)

    def q(b):
        return ((1 + 3 * b * b / e2) * np.arctan(e / b) - 3 * b / e) / 2

    turning = OMEGA**2 / 2 * (EQUATOR**2 * q(u) / q(polar) * (z * z / u2 - 1 / 3) + x * x)
    return GM / e * np.arctan(e / u) + turning


def normal_latitude(phi, height_m):
    """Latitude (rad) of the zenith of normal gravity at a geodetic latitude and height: the potential differentiated."""
    prime = EQUATOR / np.sqrt(1 - FLATTENING * (2 - FLATTENING) * np.sin(phi) ** 2)
    place = np.array(
        [(prime + height_m) * np.cos(phi), (prime * (1 - FLATTENING) ** 2 + height_m) * np.sin(phi)]
    )
    down = [normal_potential(place + 50 * e) - normal_potential(place - 50 * e) for e in np.eye(2)]
    return np.arctan2(-down[1], -down[0])


@pytest.mark.parametrize("height_m", [-400.0, 1000.0, 3000.0, 9000.0])
@pytest.mark.parametrize("latitude", [-80.0, -45.0, -5.0, 0.0, 20.0, 45.0, 70.0, 90.0])
def test_a_place_under_normal_gravity_is_found_at_any_height(latitude, height_m):
    """Gravity differentiated numerically has no deflection but the curvature of its plumb lines."""
    phi = np.radians(latitude)
    seen, at_geoid = normal_latitude(phi, height_m), Deflection(0.0, 0.0, 0.5)
    found = geodetic(seen, 1.0, 0.0, NONE, AtHeight(at_geoid, height_m))
    assert (found.latitude - phi) / ARCSEC == pytest.approx(0, abs=0.01 * abs(height_m) * 1.8e-4 + 0.006)
    assert found.deflection.stddev_arcsec == 0.5
    assert (seen - phi) / ARCSEC == pytest.approx(0.171e-3 * height_m * np.sin(2 * phi), rel=0.02, abs=0.006)


def test_an_unknown_height_widens_the_error_and_moves_nothing():
    phi = np.radians(45.0)
    d = AtHeight(Deflection(3.0, 4.0, 0.5)).at(phi, 0.0)
    assert (d.xi_arcsec, d.eta_arcsec) == (3.0, 4.0)
    assert d.stddev_arcsec == pytest.approx(np.hypot(0.5, 0.1713 * UNKNOWN_HEIGHT_M / 1000), rel=1e-3)
    stated = AtHeight(Deflection(3.0, 4.0, 0.5), 2000.0, 300.0).at(phi, 0.0)
    assert stated.xi_arcsec == pytest.approx(3.0 + 2 * 0.1713, abs=1e-3)
    assert stated.stddev_arcsec == pytest.approx(np.hypot(0.5, 0.1713 * 0.3), rel=1e-3)


@pytest.mark.parametrize(
    "values", [(np.nan, 0.0, 1.0), (0.0, np.inf, 1.0), (0.0, 0.0, -1.0), (0.0, 0.0, np.nan)]
)
def test_impossible_deflections_are_refused(values):
    with pytest.raises(InstrumentError, match="deflection"):
        Deflection(*values)


@pytest.mark.parametrize(
    ("vertical", "known"),
    [
        (Deflection(), False),
        # 8 arcsec to the north alone, in mountains that a grid resolves to 7
        (Deflection(8.0, 0.0, 7.0), True),
        (Deflection(0.0, 8.0, 7.0), True),
        (Deflection(0.0, 0.0, 1.0), True),
        # a height bends plumb lines to the north wherever nothing else is known
        (AtHeight(Deflection(), 3000.0), False),
        (AtHeight(Deflection(), 3000.0, 50.0), False),
        (AtHeight(Deflection(8.0, 0.0, 7.0), 3000.0), True),
    ],
)
def test_a_deflection_to_the_north_alone_is_known(vertical, known):
    assert vertical.at(0.7, 0.1).known is known

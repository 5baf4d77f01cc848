# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from starpos.earth.vertical import Deflection, geodetic
from starpos.errors import InstrumentError
from starpos.units import ARCSEC

NONE = np.zeros((3, 3))


def test_signs_by_hand():
    """phi = Phi - xi, lambda = Lambda - eta / cos(phi), azimuth = A - eta tan(phi); here phi 60 deg."""
    g = geodetic(np.radians(60.0), np.radians(10.0), np.radians(30.0), NONE, Deflection(10.0, 6.0, 0.0))
    assert (g.latitude - np.radians(60)) / ARCSEC == pytest.approx(-10)
    assert (g.longitude - np.radians(10)) / ARCSEC == pytest.approx(-12, abs=0.01)
    assert (g.heading - np.radians(30)) / ARCSEC == pytest.approx(-6 * np.sqrt(3), abs=0.01)
    south = geodetic(np.radians(-60.0), 0.0, 1.0, NONE, Deflection(10.0, 6.0, 0.0))
    assert (south.latitude + np.radians(60)) / ARCSEC == pytest.approx(-10)
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
    assert g.covariance[0, 2] > 0  # east and clockwise go together: both are minus eta
    assert g.covariance[1, 2] == g.covariance[0, 1] == 0
    before = np.diag([4.0, 9.0, 1e-10])
    np.testing.assert_array_equal(
        geodetic(0.5, 0.0, 0.0, before, Deflection(1.0, 1.0, 0.0)).covariance, before
    )


def test_a_heading_that_is_none_stays_none():
    covariance = np.diag([1.0, 1.0, np.nan])
    g = geodetic(0.5, 1.0, float("nan"), covariance, Deflection())
    assert np.isnan(g.heading)
    assert np.isfinite(g.covariance[:2, :2]).all()


def test_ranges_are_kept_over_the_date_line_and_north():
    g = geodetic(0.5, -np.pi, 0.0, NONE, Deflection(0.0, 5.0, 0.0))
    assert g.longitude == pytest.approx(np.pi, abs=1e-4)
    assert 2 * np.pi - 1e-4 < g.heading < 2 * np.pi
    assert np.isfinite(geodetic(np.pi / 2, 0.0, 0.0, NONE, Deflection(0.0, 5.0)).longitude)


@pytest.mark.parametrize(
    "values", [(np.nan, 0.0, 1.0), (0.0, np.inf, 1.0), (0.0, 0.0, -1.0), (0.0, 0.0, np.nan)]
)
def test_impossible_deflections_are_refused(values):
    with pytest.raises(InstrumentError, match="deflection"):
        Deflection(*values)

# SPDX-License-Identifier: Apache-2.0
"""The Sun, the Moon and Venus against worked examples of J. Meeus, Astronomical Algorithms, 2nd edition, 1998.

Those rest on VSOP87 and ELP-2000, not on ERFA's series.
"""

import erfa
import numpy as np
import pytest

from starpos.earth.orientation import earth_state
from starpos.sky.bodies import body_at
from starpos.units import ARCSEC, unix_of


def apparent(name: str, utc: str) -> tuple[float, float, float]:
    """Right ascension and declination of date (deg), and the distance (m); utc: the example's TT less TT-UTC."""
    state = earth_state(unix_of(utc))
    body = body_at(name, state)
    x, y, z = body.itrs
    days = state.utc_unix_s / 86400
    ut1 = 2440587.5, days + state.orientation.ut1_minus_utc_s / 86400
    tt = 2451545.0, (state.year - 2000) * 365.25
    turn = np.degrees(np.arctan2(y, x) + erfa.gst06a(*ut1, *tt))
    return turn % 360, np.degrees(np.arcsin(z)), body.distance_m


@pytest.mark.parametrize(
    ("name", "utc", "ra", "dec", "arcsec"),
    [
        # examples 25.b, 47.a and 33.a
        ("sun", "1992-10-12T23:59:00.816", 198.378125, -7.783817, 1.0),
        ("moon", "1992-04-11T23:59:01.816", 134.688470, 13.768368, 10.0),
        ("venus", "1992-12-19T23:59:00.816", 316.172725, -18.888011, 6.0),
    ],
)
def test_a_body_is_where_others_compute_it(name: str, utc: str, ra: float, dec: float, arcsec: float) -> None:
    found_ra, found_dec, _ = apparent(name, utc)
    off = np.hypot((found_ra - ra) * np.cos(np.radians(dec)), found_dec - dec) * 3600
    assert off < arcsec


def test_the_moon_is_as_far_away_as_in_the_example() -> None:
    assert apparent("moon", "1992-04-11T23:59:01.816")[2] == pytest.approx(368409.7e3, abs=50e3)


def test_parallax_lowers_a_body_towards_the_horizon() -> None:
    moon = body_at("moon", earth_state(unix_of("2025-03-01T12:00:00")))
    # a place on the equator, where the ellipsoid's normal goes through the centre, a quarter of a turn from the Moon
    zenith = np.cross([0.0, 0.0, 1.0], moon.itrs)
    zenith /= np.linalg.norm(zenith)
    seen = moon.from_place(zenith)
    assert -np.arcsin(seen @ zenith) == pytest.approx(moon.parallax, rel=2e-4)
    assert 0.25 * 3600 < moon.radius / ARCSEC < 0.28 * 3600

# SPDX-License-Identifier: Apache-2.0
"""The tide of the plumb line against a published size, astropy's ephemeris and the direction of the Moon."""

import numpy as np
import pytest

from starpos.earth import gravity as tides
from starpos.earth.ellipsoid import enu_axes
from starpos.earth.gravity import gravity, itrs_place

MONTH_H = np.arange(0, 29.53 * 24, 2.0)


def test_the_moons_semidiurnal_pull_at_the_equator_is_a_thirteen_millionth_of_gravity():
    # Popular Science Monthly 74 (1909), 529: "at the equator the mean value of the semi-diurnal force at 9 or 3 o'clock
    # is equal to one thirteen-millionth part of the force of gravity"
    place = itrs_place(0.0, 0.0, 0.0)
    east = enu_axes(0.0, 0.0)[0]
    pull = np.array([tides.tidal_pull(1.75e9 + 3600 * h, place) @ east for h in MONTH_H])
    # the Moon's mean semidiurnal wave, M2, the Sun's S2 and the elliptic N2, in deg an hour
    waves = np.radians(np.outer(MONTH_H, [28.9841042, 30.0, 28.4397295, 15.0410686, 13.9430356]))
    design = np.column_stack([np.cos(waves), np.sin(waves), np.ones(len(waves))])
    fitted = np.linalg.lstsq(design, pull, rcond=None)[0]
    m2 = np.hypot(fitted[0], fitted[5]) / np.linalg.norm(gravity(place))
    assert 1 / m2 == pytest.approx(13e6, rel=0.03)


def test_the_pull_is_that_of_the_bodies_where_astropy_has_them():
    from astropy import units
    from astropy.coordinates import get_body
    from astropy.time import Time

    at = 1.75e9
    # with TDB - UTC since 2017 stated: from UTC, astropy warns where its table of leap seconds is old
    dynamical = Time(2440587.5, (at + 69.184) / 86400, format="jd", scale="tdb")
    place = itrs_place(0.8, 0.3, 400.0)
    pull = np.zeros(3)
    for name, strength in (("moon", 4.9048695e12), ("sun", 1.32712440018e20)):
        body = get_body(name, dynamical, ephemeris="builtin")
        itrs = tides.earth_state(at).gcrs_to_itrs @ body.cartesian.xyz.to_value(units.m)
        # Newton, at the place and at the Earth's centre
        for where, sign in ((place, 1), (np.zeros(3), -1)):
            away = itrs - where
            pull += sign * strength * away / np.linalg.norm(away) ** 3
    assert tides.tidal_pull(at, place) == pytest.approx(pull, rel=2e-3, abs=2e-10)


def test_up_leans_away_from_the_moon_and_by_no_more_than_the_published_most():
    place, enu = itrs_place(0.7, 0.1, 0.0), enu_axes(0.7, 0.1)
    lean = np.array([tides.plumb_tide(1.75e9 + 3600 * h, place, enu) for h in MONTH_H[:200]])
    # 3/2 (mass ratio) (radius / distance)^3, of Moon and Sun, times 1 + k - l: 0.017 and 0.008 arcsec before yielding
    most = np.degrees(np.hypot(*lean.T).max()) * 3600
    assert 0.015 < most < 1.21 * (0.0174 * 1.18 + 0.0080 * 1.06)
    pull = tides.tidal_pull(1.75e9, place)
    assert lean[0] @ (enu[:2] @ pull) < 0

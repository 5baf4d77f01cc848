# SPDX-License-Identifier: Apache-2.0
"""Where a satellite is seen among the stars, each trap against a formula or a program of others."""

import erfa
import numpy as np
import pytest
from astropy.coordinates import GCRS, TEME, CartesianRepresentation
from astropy.time import Time

from starpos.earth.gravity import itrs_place
from starpos.earth.orientation import earth_state
from starpos.satellites.elements import Ephemeris, read_orbits, teme_to_gcrs
from starpos.satellites.orbits import Moments, observed, raised, states
from starpos_testing.skies import sightings as skies

PLACE = 40.0, 10.0, 1500.0


def test_the_axes_of_sgp4_are_not_the_equinox_of_date():
    t = Time(skies.NIGHT, format="unix", scale="utc")
    turn = teme_to_gcrs(earth_state(skies.NIGHT))
    for k in range(3):
        theirs = TEME(CartesianRepresentation(*np.eye(3)[k]), obstime=t).transform_to(GCRS(obstime=t))
        # astropy's UT1 and pole are of the same table: 0.002 arcsec is 0.07 m in a low orbit
        assert np.linalg.norm(turn[:, k] - theirs.cartesian.xyz.value) < 1e-8
    # the equation of the equinoxes lies between TEME and the true equinox of date, 470 m here
    of_date = np.asarray(erfa.pnm06a(t.tt.jd1, t.tt.jd2)).T
    assert np.linalg.norm(turn[:, 0] - of_date[:, 0]) > 5e-6


@pytest.fixture(scope="module")
def one(tmp_path_factory):
    """A satellite 45 deg high or so at NIGHT, its record and its orbit."""
    records, text = skies.drawn(400, 3)
    path = tmp_path_factory.mktemp("orbits") / "active.tle"
    path.write_text(text)
    orbits, said = read_orbits(path)
    assert not said
    high = [skies.sight(r, PLACE, skies.NIGHT)[1] for r in records]
    k = int(np.argmax(high))
    assert high[k] > 0.7
    return records[k], orbits[k]


def direction(orbit, earth=None):
    """Where our code sees it at NIGHT, and how far away."""
    moments = Moments.at(np.array([skies.NIGHT]))
    r, v = states([orbit], moments, np.zeros(1))
    site, _ = moments.site(itrs_place(*np.radians(PLACE[:2]), PLACE[2]), 0.0)
    u, distance = observed(r, v, site, moments.velocity if earth is None else earth)
    return u[0], distance[0]


def test_light_time_and_the_aberration_that_only_stars_have(one):
    record, orbit = one
    theirs, _ = skies.sight(record, PLACE, skies.NIGHT)
    ours, distance = direction(orbit)
    # 5 mas; diurnal aberration is the stars' and the satellite's alike
    assert np.linalg.norm(ours - theirs) < 2.5e-8
    # without the stars' aberration it would stand up to 20.5 arcsec off
    assert np.linalg.norm(direction(orbit, np.zeros((1, 3)))[0] - theirs) * distance > 10


def test_the_observer_turns_by_ut1_and_stands_above_the_ellipsoid():
    """Against the angle of Capitaine et al. (2000) by UT1, and the ellipsoid's closed formula, not the geoid."""
    moments, place = Moments.at(np.array([skies.NIGHT])), itrs_place(*np.radians(PLACE[:2]), PLACE[2])
    latitude, e2, a = np.radians(PLACE[0]), 0.00669437999014, 6378137.0
    prime = a / np.sqrt(1 - e2 * np.sin(latitude) ** 2)
    assert np.hypot(*place[:2]) == pytest.approx((prime + PLACE[2]) * np.cos(latitude), abs=1e-3)
    assert place[2] == pytest.approx((prime * (1 - e2) + PLACE[2]) * np.sin(latitude), abs=1e-3)
    days = skies.NIGHT / 86400 + 2440587.5 - 2451545.0
    t = Time(skies.NIGHT, format="unix", scale="utc")

    def turned(seconds):
        """Place in GCRS by that time of the Earth's rotation, the pole and precession by ERFA."""
        turn = 2 * np.pi * (0.7790572732640 + 1.00273781191135448 * (days + seconds / 86400))
        c, s = np.cos(turn), np.sin(turn)
        to_intermediate = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
        return erfa.c2i06a(t.tt.jd1, t.tt.jd2).T @ to_intermediate @ place

    site, _ = moments.site(place, 0.0)
    # 10 m of polar motion are left out above
    assert np.linalg.norm(turned(t.delta_ut1_utc) - site[0]) < 20
    assert np.linalg.norm(turned(0.0) - site[0]) > 50


def test_a_published_position_by_the_constants_of_wgs_72(tmp_path):
    # Vallado et al. 2006, AIAA 2006-6753: satellite 5 at its epoch
    (tmp_path / "5.tle").write_text(
        "1 00005U 58002B   00179.78495062  .00000023  00000-0  28098-4 0  4753\n"
        "2 00005  34.2682 348.7242 1859667 331.7664  19.3264 10.82419157413667\n"
    )
    (orbit,), _ = read_orbits(tmp_path / "5.tle")
    r, v = states([orbit], Moments.at(np.array([orbit.epoch_unix_s])), np.zeros(1))
    back = teme_to_gcrs(earth_state(orbit.epoch_unix_s)).T
    assert back @ r[0] == pytest.approx([7022465.29266, -1400082.96755, 39.95155], abs=0.01)
    assert back @ v[0] == pytest.approx([1893.841015, 6405.893759, 4534.807250], abs=1e-5)


@pytest.mark.parametrize("zenith_deg", [30.0, 70.0])
def test_refraction_of_something_near(zenith_deg):
    """A ray through 100 km of air, against the straight line that its last direction continues."""
    top, scale, radius = 100e3, 8400.0, 6_370_000.0
    h = np.linspace(0, top, 400_001)
    density = 2.77e-4 * np.exp(-h / scale)
    n, r = 1 + density, radius + h
    constant = n[0] * r[0] * np.sin(np.radians(zenith_deg))
    sine = constant / (n * r)
    step = sine / np.sqrt(1 - sine**2) / r
    swept = float((step[1:] + step[:-1]) @ np.diff(h)) / 2
    # beyond the air: place, and direction against the observer's vertical
    place = r[-1] * np.array([np.sin(swept), np.cos(swept)])
    angle = np.arcsin(constant / r[-1]) + swept
    way = np.array([np.sin(angle), np.cos(angle)])
    # where that straight line crosses the observer's vertical
    crossing = place[1] - place[0] / way[0] * way[1] - radius
    site = np.array([radius, 0.0, 0.0])
    ours = raised(site, np.array([[np.cos(angle), np.sin(angle), 0.0]]))[0]
    assert 2 < crossing < 25
    assert ours == pytest.approx(crossing, rel=0.12)


def test_an_ephemeris_is_interpolated():
    t = np.arange(0, 4 * 3600, 900.0)
    rate, radius = 2 * np.pi / 43200, 2.656e7

    def circle(x):
        return radius * np.stack([np.cos(rate * x), np.sin(rate * x), 0 * x], -1)

    place, speed = Ephemeris(t, circle(t)).at(7700.0)
    assert np.linalg.norm(place - circle(np.array(7700.0))) < 0.1
    assert np.linalg.norm(speed) == pytest.approx(rate * radius, rel=1e-6)
    assert np.isnan(Ephemeris(t, circle(t)).at(-1.0)[0]).all()

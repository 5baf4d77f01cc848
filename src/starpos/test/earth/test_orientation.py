# SPDX-License-Identifier: Apache-2.0
"""A1 against ERFA's and SOFA's published numbers and against astropy."""

import calendar
import subprocess
import sys
import warnings

import erfa
import numpy as np
import pytest

from starpos.earth.ellipsoid import curvature_radii_m
from starpos.earth.orientation import (
    EXTRAPOLATION_DAYS,
    EXTRAPOLATION_SIGMA_S,
    POLE_SIGMA_RAD,
    EarthOrientation,
    earth_motion,
    earth_orientation,
    earth_state,
    station_velocity,
    utc_text,
)
from starpos.earth.refraction import Atmosphere
from starpos.errors import TimeError
from starpos.sky.site import Site
from starpos.units import ARCSEC, MAS
from starpos_testing.patience import WAIT_S


def unix_of(*utc):
    return float(calendar.timegm((*utc, 0, 0, 0)[:6]))


def space_moved(star, state):
    """Barycentric catalogue place with proper motion AND parallax at the date (ERFA eraPmpx), unit vector (1, 3).

    The catalogue rounds places and parallaxes, so published cases do without it.
    """
    years = (
        state.year
        - 2000.0
        + np.dot(state.astrom["eb"], erfa.s2c(*star[:2])) * erfa.AULT / erfa.DAYSEC / 365.25
    )
    return erfa.pmpx(*star, years, state.astrom["eb"])[None]


def observed(direction, state, site):
    """Azimuth, zenith distance (rad) as `Site.observed` has them for one ICRS direction."""
    v = state.to_itrs(direction) + station_velocity(site.enu[2])
    east, north, up = site.atmosphere.refraction().bend(
        v / np.linalg.norm(v, axis=1, keepdims=True) @ site.enu.T
    )[0]
    return np.arctan2(east, north) % (2 * np.pi), np.arctan2(np.hypot(east, north), up)


def test_erfa_atco13():
    """t_atco13 of ERFA's test suite (t_erfa_c.c): catalogue to observed place, 81 deg from the zenith."""
    utc = (2456384.5 - 2440587.5 + 0.969254051) * 86400
    state = earth_state(
        utc,
        EarthOrientation(
            ut1_minus_utc_s=0.1550675,
            ut1_sigma_s=0.0,
            pole_x=2.47230737e-7,
            pole_y=1.82640464e-6,
            pole_sigma=0.0,
        ),
    )
    site = Site(
        np.degrees(-1.2345856),
        np.degrees(-0.527800806),
        Atmosphere(pressure_pa=73100.0, temperature_c=12.8, humidity=0.59, wavelength_um=0.55),
    )
    azimuth, zenith = observed(space_moved((2.71, 0.174, 1e-5, 5e-6, 0.1, 55.0), state), state, site)
    # neglected: the site's 2738 m, 7e-10 rad of diurnal aberration; TT for TDB
    assert azimuth == pytest.approx(0.9251774485485515207e-1, abs=2e-9)
    assert zenith == pytest.approx(1.407661405256499357, abs=2e-9)


def sofa_star():
    """The fictitious star of the SOFA Astrometry Tools cookbook (section 6), its Earth orientation and UTC."""
    ra, dec = np.radians(15 * (14 + 34 / 60 + 16.81183 / 3600)), -np.radians(12 + 31 / 60 + 10.3965 / 3600)
    star = ra, dec, np.arctan2(-0.35445 * ARCSEC, np.cos(dec)), 0.59535 * ARCSEC, 0.16499, 0.0
    orientation = EarthOrientation(
        ut1_minus_utc_s=0.1550675,
        ut1_sigma_s=0.0,
        pole_x=50.995e-3 * ARCSEC,
        pole_y=376.723e-3 * ARCSEC,
        pole_sigma=0.0,
    )
    return star, earth_state(unix_of(2013, 4, 2, 23, 15, 43) + 0.55, orientation)


def test_sofa_cookbook_geocentric():
    """CIRS 14 34 20.2370587 -12 34 36.381654, the cookbook's own output, before the Earth's turning."""
    star, state = sofa_star()
    cirs = (state.to_itrs(space_moved(star, state)) @ state.cirs_to_itrs)[0]
    ra, dec = erfa.anp(erfa.c2s(cirs)[0]), erfa.c2s(cirs)[1]
    assert ra == pytest.approx(np.radians(15 * (14 + 34 / 60 + 20.2370587 / 3600)), abs=0.02 * MAS)
    assert dec == pytest.approx(-np.radians(12 + 34 / 60 + 36.381654 / 3600), abs=0.02 * MAS)


def test_sofa_cookbook_observed():
    """Observed 14 34 16.9649106 -12 34 44.643094, turned by hand into azimuth and zenith distance."""
    star, state = sofa_star()
    longitude, latitude = -(5 + 41 / 60 + 54.2 / 3600), -(15 + 57 / 60 + 42.8 / 3600)
    site = Site(
        latitude,
        longitude,
        Atmosphere(pressure_pa=95200.0, temperature_c=18.5, humidity=0.83, wavelength_um=0.55),
    )
    azimuth, zenith = observed(space_moved(star, state), state, site)
    ra = np.radians(15 * (14 + 34 / 60 + 16.9649106 / 3600))
    dec = -np.radians(12 + 34 / 60 + 44.643094 / 3600)
    o = state.orientation
    utc = erfa.dtf2d("UTC", 2013, 4, 2, 23, 15, 43.55)
    local = erfa.apio13(
        *utc, o.ut1_minus_utc_s, np.radians(longitude), 0.0, 0.0, o.pole_x, o.pole_y, 0.0, 0.0, 0.0, 0.55
    )
    hour, phi = local["eral"] - ra, np.radians(latitude)
    east = -np.cos(dec) * np.sin(hour)
    north = np.sin(dec) * np.cos(phi) - np.cos(dec) * np.cos(hour) * np.sin(phi)
    up = np.sin(phi) * np.sin(dec) + np.cos(phi) * np.cos(dec) * np.cos(hour)
    # neglected: the site's 625 m; the published digits end at 1e-7 s, 1.5 micro-arcsec
    assert zenith == pytest.approx(np.arccos(up), abs=0.1 * MAS)
    assert azimuth == pytest.approx(np.arctan2(east, north) % (2 * np.pi), abs=0.1 * MAS)


def astropys_end() -> float:
    """Unix time at which the Earth orientation that astropy itself uses ends."""
    from astropy.utils import iers

    return float(iers.earth_orientation_table.get()["MJD"][-1].to_value("d") - 40587) * 86400


def test_astropy_altaz(rng):
    """Random stars, dates and places to 1 mas of astropy's AltAz, 20 deg and more above the horizon.

    Its Earth orientation is bulletin B's, here it is A's; they agree to that since about 1990.
    """
    from astropy import units as u
    from astropy.coordinates import AltAz, EarthLocation, SkyCoord
    from astropy.time import Time
    from astropy.utils import iers

    air = Atmosphere(pressure_pa=88000.0, temperature_c=12.0, humidity=0.3)
    worst = 0.0
    with iers.conf.set_temp("auto_download", False), iers.conf.set_temp("auto_max_age", None):
        for _ in range(12):
            utc = rng.uniform(unix_of(1995, 1, 1), min(unix_of(2027, 1, 1), astropys_end()))
            phi, lam = np.degrees(np.arcsin(rng.uniform(-1, 1))), rng.uniform(-180, 180)
            frame = AltAz(
                obstime=Time(utc, format="unix"),
                location=EarthLocation.from_geodetic(lam * u.deg, phi * u.deg, 0 * u.m),
                pressure=880 * u.hPa,
                temperature=12 * u.deg_C,
                relative_humidity=0.3,
                obswl=0.55 * u.um,
            )
            v = rng.normal(size=(60, 3))
            v /= np.linalg.norm(v, axis=1, keepdims=True)
            ra, dec = erfa.c2s(v)
            there = SkyCoord(ra * u.rad, dec * u.rad).transform_to(frame)
            theirs = erfa.s2c(np.pi / 2 - there.az.rad, there.alt.rad)
            site, state = Site(phi, lam, air), earth_state(utc)
            mine = state.to_itrs(v) + station_velocity(site.enu[2])
            mine = air.refraction().bend(mine / np.linalg.norm(mine, axis=1, keepdims=True) @ site.enu.T)
            high = theirs[:, 2] > np.sin(np.radians(20))
            worst = max(worst, np.linalg.norm(mine - theirs, axis=1)[high].max())
    assert worst < 1 * MAS


def test_a_position_of_a_state_is_what_site_observed_gives(catalogue):
    state = earth_state(unix_of(2026, 11, 2, 18))
    site = Site(35.7, 51.4)
    index = catalogue.cone(np.array([0.0, 0.0, 1.0]), 0.02)
    expected = [observed(catalogue.directions([i], state.year), state, site) for i in index]
    east, north, up = site.observed(catalogue, index, state).T
    np.testing.assert_allclose(np.arctan2(east, north) % (2 * np.pi), [e[0] for e in expected], atol=1e-12)
    np.testing.assert_allclose(np.arccos(up), [e[1] for e in expected], atol=1e-12)


@pytest.mark.parametrize(
    "utc",
    ["1973-06-30T12:00:00", "1999-03-01T01:02:03", "2015-06-30T06:00:00", "2016-12-31T00:00:00", "2016-12-31T12:00:00",
     "2016-12-31T23:59:59", "2017-01-01T00:00:00", "2024-02-29T23:00:00", "2026-11-02T18:00:00"],
)  # fmt: skip
def test_ut1_is_astropys_even_on_days_of_leap_seconds(utc):
    from astropy.time import Time
    from astropy.utils import iers

    moment = unix_of(*(int(p) for p in utc.replace("T", "-").replace(":", "-").split("-")))
    with iers.conf.set_temp("auto_download", False), iers.conf.set_temp("auto_max_age", None):
        if moment > astropys_end():
            pytest.skip("the table that this astropy ships ends before")
        t = Time(utc, scale="utc")
        theirs = float(t.delta_ut1_utc)
        era = erfa.era00(t.ut1.jd1, t.ut1.jd2)
    # bulletin A here, bulletin B there: they differ by up to 1 ms in the first years
    tolerance = 1e-3 if utc < "1985" else 5e-5
    assert earth_orientation(moment).ut1_minus_utc_s == pytest.approx(theirs, abs=tolerance)
    state = earth_state(moment)
    x = state.cirs_to_itrs[:, 0]
    turned = np.arctan2(-x[1], x[0])
    assert (turned - era + np.pi) % (2 * np.pi) - np.pi == pytest.approx(0, abs=tolerance * 7.3e-5 + 1e-9)


def test_pole_is_that_of_bulletin_b(rng):
    from astropy.time import Time
    from astropy.utils import iers
    from astropy_iers_data import IERS_A_FILE

    table = iers.IERS_A.open(IERS_A_FILE)
    for _ in range(5):
        utc = rng.uniform(unix_of(1990, 1, 1), unix_of(2026, 1, 1))
        x, y = table.pm_xy(Time(utc, format="unix"))
        o = earth_orientation(utc)
        assert (o.pole_x, o.pole_y) == pytest.approx((x.to_value("rad"), y.to_value("rad")), abs=3e-9)


def test_beyond_the_tables_the_sigma_grows_without_a_jump_or_a_warning():
    end = last_day()
    days = np.array([-1.0, -1e-3, 1e-3, 10, 100, 400, 800, EXTRAPOLATION_DAYS[-1] - 0.01])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        o = [earth_state(end + d * 86400).orientation for d in days]
    sigma = [k.ut1_sigma_s for k in o]
    assert np.all(np.diff(sigma) > 0)
    assert sigma[-1] > 0.3
    assert o[2].ut1_minus_utc_s == pytest.approx(o[1].ut1_minus_utc_s, abs=1e-4)
    assert [k.extrapolated_days > 0 for k in o] == [False] * 2 + [True] * 6
    assert o[3].pole_sigma > o[1].pole_sigma


def test_beyond_the_tables_the_days_go_on_lengthening_as_in_the_last_year():
    end, day = last_day(), 86400.0
    before, at, after = (earth_orientation(end + d * day).ut1_minus_utc_s for d in (-365, 0, 365))
    assert after - at == pytest.approx(at - before, abs=0.003)


def test_the_sigmas_of_extrapolation_are_what_it_would_have_erred_since_1974():
    from astropy.utils import iers
    from astropy_iers_data import IERS_A_FILE

    table = iers.IERS_A.open(IERS_A_FILE)
    measured = np.asarray(table["UT1Flag"]) != "P"
    mjd, ut1 = np.asarray(table["MJD"].value)[measured], np.asarray(table["UT1_UTC"].value)[measured]
    # Without leap seconds.
    ut1 = ut1 - np.round((erfa.utctai(2400000.5, mjd)[1] - mjd) * 86400)
    pole = np.stack([table[c][measured].to_value("rad") for c in ("PM_x", "PM_y")], -1)
    for days, sigma in zip(EXTRAPOLATION_DAYS[1:], EXTRAPOLATION_SIGMA_S[1:], strict=True):
        now = np.arange(365, len(ut1) - int(days))
        carried = ut1[now] + (ut1[now] - ut1[now - 365]) * days / 365
        rms = np.sqrt(np.mean((carried - ut1[now + int(days)]) ** 2))
        assert rms < sigma < 1.3 * rms
        assert np.sqrt(np.mean((pole[now] - pole[now + int(days)]) ** 2)) < 1.2 * POLE_SIGMA_RAD


def last_day():
    """The table's last instant, found through the public function."""
    low, high = unix_of(2024, 1, 1), unix_of(2100, 1, 1)
    while high - low > 1e-3:
        middle = (low + high) / 2
        try:
            inside = earth_orientation(middle).extrapolated_days == 0
        except TimeError:
            inside = False
        low, high = (middle, high) if inside else (low, middle)
    return low


@pytest.mark.parametrize(
    "utc",
    [
        unix_of(1972, 12, 31),
        -1e18,
        unix_of(1971, 1, 2),
        unix_of(2200, 1, 1),
        1e18,
        float("nan"),
        float("inf"),
    ],
)
def test_a_time_outside_the_tables_is_refused_with_one_sentence(utc):
    with pytest.raises(TimeError) as e:
        earth_state(utc)
    assert "\n" not in str(e.value)
    assert "check" in str(e.value)


@pytest.mark.parametrize("year", [1973, 1999, 2017, 2026])
def test_motion_is_that_of_the_whole_state(year):
    utc = unix_of(year, 5, 17, 3)
    (epoch, velocity), state = earth_motion(utc), earth_state(utc)
    assert epoch == pytest.approx(state.year, abs=60 / 31557600)
    np.testing.assert_allclose(velocity, state.velocity, rtol=0, atol=0.3 * MAS)


def test_motion_needs_no_tables():
    for year in (1901, 1950, 2035, 2099):
        epoch, velocity = earth_motion(unix_of(year, 7, 1))
        assert epoch == pytest.approx(year + 0.5, abs=0.01)
        assert np.linalg.norm(velocity) * erfa.CMPS == pytest.approx(29780, rel=0.02)
    program = (
        "import sys; from starpos.earth.orientation import earth_motion; earth_motion(0.0)\n"
        "print('astropy' in sys.modules)"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True, timeout=WAIT_S
    )
    assert done.stdout == "False\n"


@pytest.mark.parametrize(
    "utc", [unix_of(1899, 12, 31), unix_of(2101, 1, 1), -1e18, 1e300, float("nan"), float("-inf")]
)
def test_motion_at_an_impossible_date_is_refused_with_one_sentence(utc):
    with warnings.catch_warnings(), pytest.raises(TimeError, match="between 1900 and 2100: check") as e:
        warnings.simplefilter("error")
        earth_motion(utc)
    assert "\n" not in str(e.value)


def test_utc_text():
    assert utc_text(unix_of(2016, 12, 31, 23, 59, 59) + 0.25) == "2016-12-31T23:59:59.250Z"
    assert utc_text(1e30) == "1e+30 s after 1970"


def test_curvature_radii_are_those_of_wgs_84():
    """ERFA eraGd2gc: one arcsec of latitude and of longitude on the ellipsoid."""
    for degrees in (0.0, 35.7, -60.0, 89.0):
        phi = np.radians(degrees)
        here, north, east = (
            erfa.gd2gc(1, lon, lat, 0.0) for lon, lat in ((0.0, phi), (0.0, phi + ARCSEC), (ARCSEC, phi))
        )
        prime, meridian = curvature_radii_m(phi)
        assert np.linalg.norm(north - here) == pytest.approx(meridian * ARCSEC, rel=1e-5)
        assert np.linalg.norm(east - here) == pytest.approx(prime * np.cos(phi) * ARCSEC, rel=1e-5)


def test_the_ground_moves_east():
    """A sidereal day's turn of the ellipsoid: 465.1 m/s at the equator, none at the pole."""
    v = station_velocity(np.array([1.0, 0.0, 0.0])) * erfa.CMPS
    assert v == pytest.approx([0, 465.1, 0], abs=0.05)
    assert np.linalg.norm(station_velocity(np.array([0.0, 0.0, 1.0]))) == 0

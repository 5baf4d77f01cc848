# SPDX-License-Identifier: Apache-2.0
"""Heading, pitch and roll at a known place, against SOFA's and Meeus's published azimuths and ERFA's own chain."""

import math
from dataclasses import replace

import erfa
import numpy as np
import pytest

from starpos import rotation
from starpos.averaging.poses import mean_attitude
from starpos.earth.orientation import EarthOrientation, earth_orientation, earth_state
from starpos.earth.place import Place
from starpos.earth.refraction import Atmosphere
from starpos.earth.vertical import Deflection
from starpos.errors import PlaceError
from starpos.fix.attitude import CAMERA as CAMERA_AXES
from starpos.fix.attitude import LINK
from starpos.fix.budget import Circumstances
from starpos.fix.heading import attitude_at_place
from starpos.fix.solver import placed
from starpos.fix.star_fit import MatchedStars
from starpos.instrument.camera import Camera
from starpos.instrument.instrument import TOP_OF_FRAME, Instrument
from starpos.sky.site import Site, camera_to_enu
from starpos.units import ARCSEC, UNIX_EPOCH_JD, unix_of

EXACT = Deflection(0.0, 0.0, 0.0)
CAMERA = Camera.from_focal(1000, 700, 4636.0)
INSTRUMENT = Instrument(CAMERA.fx)
AIR = Atmosphere(pressure_pa=88000.0, temperature_c=12.0, humidity=0.3)
# 2024-02-10
NIGHT = 1707595200.0
LATITUDE, LONGITUDE = 52.0, 4.4


def axis_in(link_to_enu):
    return math.degrees(math.atan2(link_to_enu[0, 0], link_to_enu[1, 0])) % 360


def ring(azimuth_deg, altitude_deg, roll_deg, number=24, unix_s=NIGHT):
    """Stars on a frame of a camera with that attitude, whose observed places ERFA computes from ICRS ones.

    eraAtoc13 gives the stars' ICRS places from where the camera sees them, by its own chain from end to end.
    """
    attitude = camera_to_enu(azimuth_deg, altitude_deg, roll_deg)
    angle = np.linspace(0, 2 * np.pi, number, endpoint=False)
    xy = np.array(CAMERA.centre_px) + np.stack([430 * np.cos(angle), 300 * np.sin(angle)], 1)
    east, north, up = (CAMERA.directions(*xy.T) @ attitude.T).T
    eop = earth_orientation(unix_s)
    ra, dec = erfa.atoc13(
        "A", np.arctan2(east, north), np.arccos(up), UNIX_EPOCH_JD, unix_s / 86400, eop.ut1_minus_utc_s,
        math.radians(LONGITUDE), math.radians(LATITUDE), 0.0, eop.pole_x, eop.pole_y, AIR.pressure_pa / 100,
        AIR.temperature_c, AIR.humidity, AIR.wavelength_um,
    )  # fmt: skip
    places = rotation.unit_vector(ra, dec)
    stars = MatchedStars(xy, np.tile(np.eye(2) * 0.03**2, (number, 1, 1)), places, np.zeros(number))
    return stars, attitude @ np.asarray(TOP_OF_FRAME)


def place(deflection=EXACT, make=Place.by_gravity, **more):
    return make(LATITUDE, LONGITUDE, deflection, **more)


def attitude_of(stars, where=None, air=AIR, clock_s=0.0, unix_s=NIGHT, **more):
    about = Circumstances(
        camera=CAMERA,
        instrument=INSTRUMENT,
        atmosphere=air,
        earth=earth_state(unix_s),
        clock_stddev_s=clock_s,
    )
    return attitude_at_place(stars, where or place(), replace(about, **more))


@pytest.mark.parametrize(
    "pointing", [(0.0, 90.0, 0.0), (200.0, 70.0, 20.0), (310.0, 35.0, 160.0), (75.0, 20.0, -95.0)]
)
def test_attitude_is_that_of_the_chain_of_erfa(pointing):
    stars, link = ring(*pointing)
    found = attitude_of(stars)
    off = rotation.to_vector(found.plumb.rotation @ link.T)
    assert np.abs(off).max() < 0.002 * ARCSEC
    assert found.focal_scale == pytest.approx(1, abs=1e-7)


def test_azimuth_of_the_test_vector_that_sofa_publishes():
    """t_atco13 of SOFA's own test program in C (release 2016-05-03): a star's observed azimuth at 9.3 deg of altitude."""
    utc1, utc2, dut1, longitude, latitude = 2456384.5, 0.969254051, 0.1550675, -0.527800806, -1.2345856
    unix_s = (utc1 - UNIX_EPOCH_JD + utc2) * 86400
    orientation = EarthOrientation(
        ut1_minus_utc_s=dut1, ut1_sigma_s=0.0, pole_x=2.47230737e-7, pole_y=1.82640464e-6, pole_sigma=0.0
    )
    state = earth_state(unix_s, orientation)
    # proper motion, parallax and radial velocity of that star
    star = erfa.pmpx(2.71, 0.174, 1e-5, 5e-6, 0.1, 55.0, state.astrom["pmt"], state.astrom["eb"])
    air = Atmosphere(pressure_pa=73100.0, temperature_c=12.8, humidity=0.59, wavelength_um=0.55)
    site = Site(math.degrees(latitude), math.degrees(longitude), air)
    east, north, up = site.refracted(star[None], state)[0]
    assert math.atan2(east, north) == pytest.approx(0.09251774485385390973, abs=0.01 * ARCSEC)
    assert math.acos(up) == pytest.approx(1.407661405256671703, abs=0.1 * ARCSEC)


def test_azimuth_by_the_hour_angle_of_the_textbook():
    """Meeus, Astronomical Algorithms (2nd ed., 1998), example 13.b: Venus from the U.S. Naval Observatory.

    1987 April 10, 19:21:00 UT; from its apparent right ascension and declination, 248.0337 deg from north.
    """
    unix_s = unix_of("1987-04-10T19:21:00")
    state = earth_state(
        unix_s, EarthOrientation(ut1_minus_utc_s=0.0, ut1_sigma_s=0.0, pole_x=0.0, pole_y=0.0, pole_sigma=0.0)
    )
    ra, dec = math.radians((23 + 9 / 60 + 16.641 / 3600) * 15), -math.radians(6 + 43 / 60 + 11.61 / 3600)
    # from the equinox to the origin of ERFA's right ascensions
    tt = unix_s + 55.7
    ra += erfa.eo06a(UNIX_EPOCH_JD, tt / 86400)
    where = Place.by_gravity(38 + 55 / 60 + 17 / 3600, -(77 + 3 / 60 + 56 / 3600), EXACT)
    east, north, up = where.plumb_axes @ state.cirs_to_itrs @ rotation.unit_vector(ra, dec)
    assert math.degrees(math.atan2(east, north)) % 360 == pytest.approx(248.0337, abs=2e-4)
    assert math.degrees(math.asin(up)) == pytest.approx(15.1249, abs=2e-4)


def test_norths_by_the_plumb_line_and_the_ellipsoid_differ_by_laplaces_equation():
    """A - alpha = eta tan(phi) + (xi sin(A) - eta cos(A)) tan(h); Heiskanen and Moritz (1967), equation 5-17."""
    stars, _ = ring(200.0, 70.0, 20.0)
    xi, eta = 8.0, -11.0
    found = attitude_of(stars, place(Deflection(xi, eta, 0.5)))
    azimuth, height = found.plumb.heading, found.plumb.pitch
    laplace = eta * math.tan(math.radians(LATITUDE))
    laplace += (xi * math.sin(azimuth) - eta * math.cos(azimuth)) * math.tan(height)
    turned = (found.plumb.heading - found.ellipsoid.heading) / ARCSEC
    assert turned == pytest.approx(laplace, abs=0.002)
    level = found.true_north.rotation
    assert found.true_north.heading - found.plumb.heading == pytest.approx(
        -eta * ARCSEC * math.tan(math.radians(LATITUDE)), abs=0.002 * ARCSEC
    )
    assert level[2] == pytest.approx(found.plumb.rotation[2], abs=1e-12)


@pytest.mark.parametrize("geodetic", [False, True])
def test_the_deflections_error_is_in_the_heading_of_the_north_that_was_not_stated(geodetic):
    stars, _ = ring(200.0, 85.0, 20.0)
    make = Place.on_ellipsoid if geodetic else Place.by_gravity
    found = attitude_of(stars, place(Deflection(0.0, 0.0, 6.0), make))
    sigma = [math.sqrt(a.angles_covariance[0, 0]) / ARCSEC for a in (found.plumb, found.ellipsoid)]
    own, other = sigma[::-1] if geodetic else sigma
    assert own < 4
    assert math.sqrt(other**2 - own**2) == pytest.approx(6.0 * math.tan(math.radians(LATITUDE)), rel=0.05)


def budget(found):
    return {t.name: t.covariance for t in found.plumb.terms}


def angles(link):
    return np.array([link.heading, link.pitch, link.roll])


def test_a_late_clock_turns_the_attitude_by_its_term():
    stars, _ = ring(200.0, 55.0, 20.0)
    found, late = attitude_of(stars, clock_s=1.0), attitude_of(stars, unix_s=NIGHT + 1.0)
    turned = rotation.to_vector(late.plumb.rotation @ found.plumb.rotation.T)
    assert np.linalg.norm(turned) / ARCSEC == pytest.approx(15.04, abs=0.02)
    assert budget(found)["clock"][3:, 3:] == pytest.approx(
        np.outer(turned, turned), abs=1e-3 * (15 * ARCSEC) ** 2
    )
    moved = angles(late.plumb) - angles(found.plumb)
    assert budget(found)["clock"][2, 2] == pytest.approx(moved[0] ** 2, rel=0.01)


def test_a_wrong_place_turns_the_attitude_by_its_term():
    stars, _ = ring(200.0, 55.0, 20.0)
    # 310 m to the east, 155 m to the north
    east, north = np.array([310.0, 155.0])
    found = attitude_of(stars, place(covariance=np.outer([east, north], [east, north])))
    per_deg = 111_320.0 * math.cos(math.radians(LATITUDE))
    away = Place.by_gravity(LATITUDE + north / 111_268.0, LONGITUDE + east / per_deg, EXACT)
    moved = angles(attitude_of(stars, away).plumb) - angles(found.plumb)
    of_place = next(t for t in found.plumb.terms if t.name == "place")
    assert of_place.covariance[2, 2] == pytest.approx(moved[0] ** 2, rel=0.02)
    bare = attitude_of(stars)
    wider = found.plumb.angles_covariance - bare.plumb.angles_covariance
    assert wider == pytest.approx(np.outer(moved, moved), abs=0.03 * np.abs(moved).max() ** 2)


def test_mount_and_lens_are_in_the_claim():
    stars, _ = ring(200.0, 88.0, 20.0)
    instrument = Instrument(CAMERA.fx, mount_stddev_arcsec=30.0)
    found = attitude_of(stars, instrument=instrument, axis_stddev=40 * ARCSEC)
    # a wrong optical axis looks like a lean of the camera, which looks up
    sigma = np.sqrt(np.diag(found.plumb.angles_covariance)) / ARCSEC
    assert sigma == pytest.approx([30.0, 50.0, 50.0], rel=0.01)


def test_errors_of_stars_are_as_large_as_claimed(rng):
    """Squared errors of heading, pitch and roll over their covariance: 3 on average, over 80 frames."""
    nees = []
    for _ in range(80):
        pointing = rng.uniform(0, 360), rng.uniform(40, 90), rng.uniform(0, 360)
        stars, link = ring(*pointing, number=60)
        noisy = MatchedStars(
            stars.xy + rng.normal(0, 0.3, stars.xy.shape),
            stars.covariance_px2 * 100,
            stars.places,
            stars.place_sigma,
        )
        found = attitude_of(noisy)
        off = rotation.to_vector(found.plumb.rotation @ link.T)
        nees.append(off @ np.linalg.solve(found.plumb.covariance, off))
    # 3 sigma of the mean of 80
    assert 2.18 < np.mean(nees) < 3.82


@pytest.mark.parametrize(
    ("latitude", "longitude"), [(LATITUDE, LONGITUDE + 180), (-LATITUDE, LONGITUDE + 90)]
)
def test_a_place_that_cannot_see_these_stars_is_refused(latitude, longitude):
    stars, _ = ring(200.0, 60.0, 20.0)
    with pytest.raises(PlaceError, match="below the horizon, and a heading needs stars"):
        attitude_of(stars, Place.by_gravity(latitude, longitude, EXACT))


def test_a_place_half_round_the_earth_is_refused_by_the_refraction_though_the_stars_are_up_there():
    # the zenith of 52 deg N is 14 deg high at the other side of the pole
    stars, _ = ring(0.0, 89.0, 20.0)
    with pytest.raises(PlaceError, match="air would bend this field more"):
        attitude_of(stars, Place.by_gravity(LATITUDE, LONGITUDE + 180, EXACT))


@pytest.mark.parametrize("pressure_pa", [80000.0, 97000.0])
def test_air_that_is_not_quite_as_stated_refuses_no_place(pressure_pa):
    stars, _ = ring(100.0, 20.0, 20.0)
    stated = Atmosphere(pressure_pa=pressure_pa, temperature_c=12.0, humidity=0.3)
    assert attitude_of(stars, air=stated).jitter_px < 0.5


@pytest.mark.parametrize(
    ("latitude", "longitude"), [(91.0, 0.0), (51.4, 361.0), (math.nan, 5.0), (52.0, math.inf)]
)
def test_a_place_that_is_none_is_refused(latitude, longitude):
    for make in (Place.by_gravity, Place.on_ellipsoid):
        with pytest.raises(PlaceError, match="no place is at latitude"):
            make(latitude, longitude, EXACT)


def test_pitch_and_roll_have_the_signs_of_the_base_link():
    nose_up = attitude_of(ring(0.0, 80.0, 0.0)[0]).plumb
    assert math.degrees(nose_up.pitch) == pytest.approx(10.0, abs=1e-5)
    assert math.degrees(nose_up.roll) == pytest.approx(0.0, abs=1e-5)
    leaning = attitude_of(ring(0.0, 80.0, 70.0)[0]).plumb
    left_up = leaning.rotation[2, 1]
    assert abs(left_up) > 0.1 and math.sin(leaning.roll) * math.cos(leaning.pitch) == pytest.approx(left_up)


class TestOfAFrame:
    """Through the solver, with its identification and catalogue."""

    def test_heading_is_that_of_the_scene_within_its_claim(self, night):
        scene, stars, _, solver = night
        where = Place.by_gravity(scene.site.latitude_deg, scene.site.longitude_deg, EXACT)
        answer = placed(solver, stars, solver.identify(stars), where)
        link = answer.at_place.plumb
        assert answer.ok and answer.fix is None and "heading" in answer.message
        assert abs(rotation.half_turn(link.heading - scene.heading)) < 4 * math.sqrt(
            link.angles_covariance[0, 0]
        )
        assert math.sqrt(link.angles_covariance[0, 0]) < 3 * ARCSEC

    def test_with_a_tilt_the_place_stays_the_stars_own(self, night):
        scene, stars, tilt, solver = night
        where = Place.by_gravity(scene.site.latitude_deg, scene.site.longitude_deg, EXACT)
        alone = solver.solve(stars, tilt)
        answer = placed(solver, stars, alone, where)
        assert answer.fix is alone.fix and answer.at_place is not None and answer.message == "fix"

    def test_a_place_that_fix_and_tilt_contradict_gives_no_heading(self, night):
        scene, stars, tilt, solver = night
        where = Place.by_gravity(scene.site.latitude_deg + 1, scene.site.longitude_deg, EXACT)
        answer = placed(solver, stars, solver.solve(stars, tilt), where)
        assert answer.ok and answer.at_place is None and "from the given one" in answer.remark

    def test_a_frame_without_a_time_has_none(self, night):
        scene, stars, _, solver = night
        timeless = replace(stars, mid_unix_s=None)
        where = Place.by_gravity(scene.site.latitude_deg, scene.site.longitude_deg, EXACT)
        assert placed(solver, timeless, solver.identify(timeless), where).at_place is None


def test_frames_through_dew_do_not_turn_the_mean_of_clear_ones(rng):
    z2 = []
    for _ in range(30):
        seen = []
        for k in range(9):
            stars, link = ring(200.0, 70.0, 20.0, number=24 if k < 4 else 6)
            sigma = 0.05 if k < 4 else 3.0
            errors = np.tile(np.eye(2) * sigma**2, (len(stars.xy), 1, 1))
            off = rng.normal(0, sigma, stars.xy.shape)
            seen.append(attitude_of(replace(stars, xy=stars.xy + off, covariance_px2=errors)))
        whole = mean_attitude(seen)
        assert (whole.plumb.of, whole.optics.of) == (LINK, CAMERA_AXES)
        mean = whole.plumb
        off = rotation.to_vector(mean.rotation @ link.T)
        z2.append(off @ np.linalg.solve(mean.covariance, off) / 3)
        assert np.linalg.norm(off) < 20 * ARCSEC
    assert 0.6 < np.mean(z2) < 1.6

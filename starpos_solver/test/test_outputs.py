# SPDX-License-Identifier: Apache-2.0
"""What consumers of fix and heading rely on: frames, signs, covariances, and NaN where nothing is known."""

import math
from dataclasses import fields, replace

import numpy as np
import pytest
from sensor_msgs.msg import NavSatFix, NavSatStatus
from std_msgs.msg import Header

from starpos.earth.place import Place
from starpos.earth.vertical import Deflection
from starpos.fix.attitude import CAMERA, ITRS, Attitude, heading_of, heading_row
from starpos.fix.budget import link_attitude
from starpos.fix.fix import Fix
from starpos.fix.heading import AttitudeAtPlace
from starpos.fix.solution import NO_STARS, Solution, Status
from starpos.fix.terms import ErrorTerm
from starpos.instrument.inclinometer import Tilt
from starpos.sky.catalogue import named_stars
from starpos_interfaces import msg
from starpos_solver import outputs
from starpos_testing.headings import yaw_deg

EXACT = Deflection(0.0, 0.0, 0.0)
HEIGHT = {"altitude": 250.0, "altitude_stddev": 10.0}


def fix_facing(azimuth_deg: float, latitude_deg: float = 40.0) -> Fix:
    """A fix of a level link whose x axis points to an azimuth."""
    a = math.radians(azimuth_deg)
    forward, up = np.array([math.sin(a), math.cos(a), 0.0]), np.array([0.0, 0.0, 1.0])
    link = np.stack([forward, np.cross(up, forward), up], 1)
    factor = np.diag([100.0, 50.0, 1e-4, 2e-4, 3e-4, 1e-4])
    return Fix(
        utc_unix_s=1.8e9,
        tilt=Tilt(0.0, 0.0, np.eye(2) * 1e-10, utc_unix_s=1.8e9),
        latitude=math.radians(latitude_deg),
        longitude=1.0,
        heading=heading_of(link),
        link_to_enu=link,
        terms=(ErrorTerm("all", factor),),
        levelling=np.vstack([np.eye(2) * 6.371e6, np.zeros((4, 2))]),
        used=np.arange(3),
        residual_px=np.zeros((3, 2)),
        residual_arcsec=0.2,
        jitter_px=0.1,
        focal_scale=1.0,
        zenith_distance=0.2,
        refraction_arcsec=12.0,
        diurnal_aberration_arcsec=0.3,
        ut1_minus_utc_s=-0.05,
        camera=Attitude(np.eye(3), np.eye(3) * 1e-6, of=CAMERA, into=ITRS),
    )


def answer_facing(azimuth_deg: float) -> Solution:
    return Solution(
        Status.OK,
        "fix",
        source="stars",
        utc_unix_s=1.8e9,
        stars_detected=5,
        named=named_stars(("a", "b", "c"), np.array([5.25, 7.5, 10.0])),
        star=np.array([0, 2, 4]),
        fix=fix_facing(azimuth_deg),
    )


@pytest.mark.parametrize(("azimuth", "yaw"), [(0, 90), (90, 0), (180, -90), (270, 180), (45, 45)])
def test_yaw_is_counterclockwise_from_east(azimuth, yaw):
    answer = answer_facing(azimuth)
    message = outputs.imu(Header(), outputs.true_north(answer.fix.link, answer.fix.on_ground(EXACT)))
    assert (yaw_deg(message) - yaw + 180) % 360 - 180 == pytest.approx(0, abs=1e-9)


def test_heading_north_is_not_taken_for_none():
    answer = answer_facing(0.0)
    message = outputs.solution(Header(), answer, answer.fix.on_ground(EXACT))
    assert message.heading == 0.0
    assert message.status == msg.Solution.OK


def test_matched_stars_are_told_by_name_place_in_the_list_and_magnitude():
    answer = answer_facing(0.0)
    message = outputs.solution(Header(), answer, answer.fix.on_ground(EXACT))
    assert (message.stars_detected, message.stars_matched) == (5, 3)
    assert (message.ids, list(message.indices), list(message.magnitudes)) == (
        ["a", "b", "c"],
        [0, 2, 4],
        [5.25, 7.5, 10.0],
    )


def test_what_is_suspicious_about_the_identification_is_named():
    answer = answer_facing(0.0)
    suspicious = replace(answer, status=Status.POOR_FIT, fix=None, warnings=("two_skies", "unexplained"))
    assert outputs.solution(Header(), suspicious, None).warnings == ["two_skies", "unexplained"]
    assert outputs.solution(Header(), answer, answer.fix.on_ground(EXACT)).warnings == []


def test_rates_and_accelerations_are_declared_unmeasured():
    answer = answer_facing(10.0)
    message = outputs.imu(Header(), outputs.true_north(answer.fix.link, answer.fix.on_ground(EXACT)))
    assert message.angular_velocity_covariance[0] == -1.0
    assert message.linear_acceleration_covariance[0] == -1.0
    assert np.all(np.linalg.eigvalsh(np.array(message.orientation_covariance).reshape(3, 3)) > 0)


def test_a_fix_has_a_known_covariance_of_east_and_north():
    ground = answer_facing(10.0).fix.on_ground(EXACT)
    message = outputs.nav_sat_fix(Header(), ground, HEIGHT)
    assert message.status.status == NavSatStatus.STATUS_FIX
    assert message.position_covariance_type == NavSatFix.COVARIANCE_TYPE_KNOWN
    assert np.diag(np.array(message.position_covariance).reshape(3, 3)) == pytest.approx([1e4, 2500.0, 100.0])


def test_an_unset_altitude_stays_nan_and_its_variance_finite():
    message = outputs.nav_sat_fix(
        Header(), answer_facing(10.0).fix.on_ground(EXACT), HEIGHT | {"altitude": math.nan}
    )
    assert math.isnan(message.altitude)
    assert np.isfinite(message.position_covariance).all()


def test_no_fix_is_nan_with_an_unknown_covariance():
    message = outputs.nav_sat_fix(Header(), None, HEIGHT)
    assert message.status.status == NavSatStatus.STATUS_NO_FIX
    assert math.isnan(message.latitude) and math.isnan(message.longitude) and math.isnan(message.altitude)
    assert message.position_covariance_type == NavSatFix.COVARIANCE_TYPE_UNKNOWN


def test_the_deflection_of_the_vertical_moves_and_widens_fix_and_heading():
    answer, deflection = answer_facing(10.0), Deflection(10.0, -20.0, 5.0)
    ground, plain = answer.fix.on_ground(deflection), answer.fix.on_ground(EXACT)
    arcsec = math.radians(1 / 3600)
    assert ground.latitude - plain.latitude == pytest.approx(-10 * arcsec, rel=1e-3)
    assert ground.longitude - plain.longitude == pytest.approx(
        20 * arcsec / math.cos(ground.latitude), rel=1e-3
    )
    assert ground.covariance[0, 0] - plain.covariance[0, 0] == pytest.approx(
        (5 * arcsec * 6.387e6) ** 2, rel=1e-2
    )
    turned = yaw_deg(outputs.imu(Header(), outputs.true_north(answer.fix.link, ground))) - yaw_deg(
        outputs.imu(Header(), outputs.true_north(answer.fix.link, plain))
    )
    # azimuth = A - eta tan(phi): a smaller azimuth is a larger yaw
    assert turned * 3600 == pytest.approx(-20.0 * math.tan(ground.latitude), rel=1e-3)


def test_without_a_fix_every_number_that_is_missing_is_nan():
    answer = replace(
        answer_facing(10.0), status=Status.NOT_IDENTIFIED, fix=None, named=NO_STARS, star=None, message="why"
    )
    message = outputs.solution(Header(), answer, None)
    assert not message.ids and not message.indices and not message.magnitudes
    assert message.status == msg.Solution.NOT_IDENTIFIED
    assert message.status_text == "why"
    for name in (
        "latitude",
        "longitude",
        "heading",
        "heading_stddev",
        "focal_px",
        "log_odds",
        "residual",
        "xi",
    ):
        assert math.isnan(getattr(message, name)), name
    assert np.isnan(message.covariance).all() and np.isnan(message.covariance_geodetic).all()


def test_every_status_has_a_code_of_the_message():
    assert set(outputs.STATUS) == set(Status)
    assert len(set(outputs.STATUS.values())) == len(Status)


def test_the_budget_adds_up_and_the_deflection_to_the_geodetic_covariance():
    answer = answer_facing(30.0)
    message = outputs.solution(Header(), answer, answer.fix.on_ground(Deflection(1.0, 2.0, 3.0)))
    *others, deflection = message.budget
    assert deflection.name == "deflection" and deflection.common
    variance = np.sum([[t.east**2, t.north**2, t.heading**2] for t in others], axis=0)
    np.testing.assert_allclose(variance, np.diag(np.reshape(message.covariance, (3, 3))), rtol=1e-9)
    variance += np.square([deflection.east, deflection.north, deflection.heading])
    np.testing.assert_allclose(variance, np.diag(np.reshape(message.covariance_geodetic, (3, 3))), rtol=1e-9)
    assert deflection.north == pytest.approx(3 * 30.84, rel=0.01)


def at_place_facing(azimuth_deg: float, **places) -> AttitudeAtPlace:
    """An attitude at a known place, the same by both norths, with an error of 1e-4 rad about each axis."""
    fix = fix_facing(azimuth_deg)
    heading = heading_row(fix.link_to_enu)
    term = ErrorTerm("centroids", np.vstack([np.zeros((2, 3)), heading, np.eye(3)]) * 1e-4)
    link = link_attitude(fix.link_to_enu, (term,))
    shared = {f.name: getattr(fix, f.name) for f in fields(AttitudeAtPlace) if hasattr(fix, f.name)}
    where = Place.on_ellipsoid(40.0, 57.0, EXACT)
    return AttitudeAtPlace(**shared, place=where, plumb=link, ellipsoid=link, true_north=link)


def test_a_heading_without_a_fix_is_an_attitude_and_a_solution_without_a_place():
    answer = replace(answer_facing(60.0), status=Status.NO_TILT, fix=None, at_place=at_place_facing(60.0))
    message = outputs.solution(Header(), answer, None)
    assert message.status == msg.Solution.NO_TILT and math.isnan(message.latitude)
    assert message.heading == pytest.approx(60.0)
    assert message.heading_stddev == pytest.approx(math.degrees(1e-4))
    assert [term.name for term in message.budget] == ["centroids"]
    assert math.isnan(message.budget[0].east) and message.refraction == 12.0
    attitude = outputs.imu(Header(), answer.at_place.true_north)
    assert yaw_deg(attitude) == pytest.approx(30.0)
    assert np.diag(np.reshape(attitude.orientation_covariance, (3, 3))) == pytest.approx([1e-8] * 3)


def test_beside_a_fix_the_heading_is_that_of_the_known_place():
    answer = replace(answer_facing(60.0), at_place=at_place_facing(61.0))
    message = outputs.solution(Header(), answer, answer.fix.on_ground(EXACT))
    assert message.heading == pytest.approx(61.0) and message.latitude == pytest.approx(40.0)

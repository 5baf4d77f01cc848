# SPDX-License-Identifier: Apache-2.0
"""What a robot's localisation reads: place, ENU yaw, covariances, stamps."""

import math
from dataclasses import replace

import numpy as np
import pytest
from sensor_msgs.msg import NavSatFix, NavSatStatus

from starpos_interfaces.msg import Solution
from starpos_testing.graph.shots import LATITUDE_DEG, LONGITUDE_DEG, azimuth_for_heading, shoot
from starpos_testing.headings import yaw_deg

CARDINAL = [(0.01, 90), (359.99, 90), (90.01, 0), (89.99, 0), (180.01, -90), (179.99, -90), (270.0, 180)]


@pytest.mark.parametrize(("heading", "yaw"), CARDINAL)
def test_yaw_is_counted_from_east_against_the_clock(graph, solver, heading, yaw):
    shot = shoot(azimuth_for_heading(heading))
    solution, _, imu = graph.answer(shot)
    assert solution.status == Solution.OK
    assert abs((yaw_deg(imu) - yaw + 180) % 360 - 180) < 0.02
    assert abs((yaw_deg(imu) - (90 - heading) + 180) % 360 - 180) < 10 / 3600
    assert abs(shot.heading_error_deg(solution.heading)) < 4 * solution.heading_stddev < 10 / 3600
    assert 0 <= solution.heading < 360


def test_the_attitude_is_the_whole_one(graph, solver):
    shot = shoot(123.0)
    _, _, imu = graph.answer(shot)
    q = imu.orientation
    assert math.isclose(math.hypot(q.w, q.x, q.y, q.z), 1, abs_tol=1e-12)
    x, y, z, w = q.x, q.y, q.z, q.w
    axes = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
    truth = shot.scene.attitude @ np.asarray(shot.scene.instrument.link_to_camera)
    np.testing.assert_allclose(axes, truth, atol=np.radians(10 / 3600))
    # Z up, as REP-103 has it.
    assert axes[2, 2] > 0.97


def test_covariances_and_stamps(graph, solver):
    shot = shoot()
    solution, fix, imu = graph.answer(shot)
    for message in (solution, fix, imu):
        assert (message.header.stamp.sec, message.header.stamp.nanosec) == shot.stamp
        assert message.header.frame_id == "starpos_link"
    for numbers in (imu.orientation_covariance, solution.covariance, solution.covariance_geodetic):
        matrix = np.array(numbers).reshape(3, 3)
        np.testing.assert_allclose(matrix, matrix.T, rtol=1e-9)
        assert np.linalg.eigvalsh(matrix).min() > 0
    assert imu.angular_velocity_covariance[0] == imu.linear_acceleration_covariance[0] == -1
    # the link's x axis is not level: its azimuth takes a little of the tilt's error besides the turn about up
    assert math.isclose(
        imu.orientation_covariance[8] ** 0.5, math.radians(solution.heading_stddev), rel_tol=0.15
    )

    assert fix.status.status == NavSatStatus.STATUS_FIX
    assert fix.status.service == 0
    assert fix.position_covariance_type == NavSatFix.COVARIANCE_TYPE_KNOWN
    position = np.array(fix.position_covariance).reshape(3, 3)
    assert np.linalg.eigvalsh(position).min() > 0
    np.testing.assert_allclose(position[:2, :2], np.reshape(solution.covariance_geodetic, (3, 3))[:2, :2])
    assert math.isnan(fix.altitude)
    assert (fix.latitude, fix.longitude) == (solution.latitude_geodetic, solution.longitude_geodetic)
    error = shot.error_m(solution)
    claimed = np.linalg.inv(np.reshape(solution.covariance, (3, 3))[:2, :2])
    assert error @ claimed @ error < 4**2
    # 2 arcsec.
    assert np.abs(error).max() < 60


def test_at_a_known_place_heading_needs_no_tilt_and_there_is_no_fix(graph, solver):
    assert graph.set("solver", site__latitude=LATITUDE_DEG, site__longitude=LONGITUDE_DEG) == (True, "")
    try:
        shot = replace(shoot(210.0), tilts=[])
        solution, fix, _ = graph.answer(shot)
        graph.wait(lambda: shot.stamp in graph.imus, "for a heading without a tilt")
        imu = graph.imus[shot.stamp][-1]
        assert solution.status == Solution.NO_TILT and fix.status.status == NavSatStatus.STATUS_NO_FIX
        assert math.isnan(fix.latitude) and math.isnan(solution.latitude)
        # the site is by gravity: the unstated deflection is in the heading on WGS 84
        assert abs(shot.heading_error_deg(solution.heading)) < 4 * solution.heading_stddev < 60 / 3600
        assert abs(shot.heading_error_deg(90 - yaw_deg(imu))) < 10 / 3600
        graph.state("solver: Solution", "heading at the known place")
        refused, why = graph.set("solver", site__longitude=math.nan)
        assert not refused and "belong together" in why
    finally:
        assert graph.set("solver", site__latitude=math.nan, site__longitude=math.nan) == (True, "")

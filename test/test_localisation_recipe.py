# SPDX-License-Identifier: Apache-2.0
"""What the recipe for robot_localization says of our messages is what they are."""

import math
from pathlib import Path

import pytest
import yaml
from ament_index_python.packages import get_package_share_directory

from starpos_testing.graph.shots import LATITUDE_DEG, shoot

RECIPE = Path(get_package_share_directory("starpos_bringup")) / "config" / "robot_localization.yaml"
# Which of robot_localization's 15 state variables.
X, Y, YAW = 0, 1, 5
# self_calibration's first.
WIDEST_FIX_M = 1e6


@pytest.fixture(scope="module")
def recipe():
    return {name: node["ros__parameters"] for name, node in yaml.safe_load(RECIPE.read_text()).items()}


def usable(fix) -> bool:
    """navsat_transform's own condition (gpsFixCallback)."""
    return fix.status.status >= 0 and not any(map(math.isnan, (fix.altitude, fix.latitude, fix.longitude)))


def test_a_fix_is_dropped_by_navsat_transform_until_the_altitude_is_set(graph, solver):
    _, fix, _ = graph.answer(shoot())
    assert not usable(fix)
    assert graph.set("solver", altitude=2400.0, altitude_stddev=20.0)[0]
    _, fix, _ = graph.answer(shoot())
    assert usable(fix) and fix.position_covariance[8] == 400.0
    shot = shoot()
    shot.tilts.clear()
    _, none, _ = graph.answer(shot)
    assert not usable(none)


def test_yaw_needs_no_offset_and_no_declination(graph, solver, recipe):
    navsat, ekf = recipe["navsat_transform_node"], recipe["ekf_map"]
    assert navsat["yaw_offset"] == navsat["magnetic_declination_radians"] == 0
    shot = shoot()
    solution, _, imu = graph.answer(shot)
    q = imu.orientation
    yaw = math.atan2(2 * (q.w * q.z + q.x * q.y), 1 - 2 * (q.y**2 + q.z**2))
    assert math.isclose(math.cos(yaw - math.radians(90 - solution.heading)), 1, abs_tol=1e-9)
    # what we do not measure is marked as ROS wants it, and the recipe does not fuse it
    assert imu.angular_velocity_covariance[0] == imu.linear_acceleration_covariance[0] == -1
    assert [k for k, used in enumerate(ekf["imu0_config"]) if used] == [YAW]
    assert [k for k, used in enumerate(ekf["odom1_config"]) if used] == [X, Y]


def test_the_map_is_not_turned_by_the_robots_first_heading(recipe):
    """navsat_transform turns it by the filter's yaw less this one: of one message, or of two around the first fix."""
    assert recipe["navsat_transform_node"]["use_odometry_yaw"] is True


def test_a_fix_that_becomes_better_is_not_shut_out(recipe):
    ekf = recipe["ekf_map"]
    assert not [name for name in ekf if name.endswith("rejection_threshold")]
    start = ekf["initial_estimate_covariance"]
    assert len(start) == 15 and start[X] == start[Y] >= WIDEST_FIX_M**2 and start[YAW] >= math.pi**2
    # Only what is measured has a variance.
    assert sum(variance > 1e-9 for variance in start) == 3


def test_a_lagging_fix_is_put_where_it_belongs(graph, solver, recipe):
    assert recipe["ekf_map"]["smooth_lagged_data"] is True and recipe["ekf_map"]["history_length"] >= 5
    shot = shoot()
    _, fix, imu = graph.answer(shot)
    stamps = {(m.header.stamp.sec, m.header.stamp.nanosec) for m in (fix, imu, shot.stars)}
    # The middle of the exposure.
    assert len(stamps) == 1
    assert abs(fix.latitude - LATITUDE_DEG) < 0.01

# SPDX-License-Identifier: Apache-2.0
"""The solver with `gyro`: frames of few stars of a camera that turns have an attitude, and without it none."""

from copy import deepcopy

import numpy as np
import pytest
from geometry_msgs.msg import Vector3
from rclpy.qos import QoSProfile
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import Imu
from std_msgs.msg import Header
from std_srvs.srv import Trigger

from starpos.messages.stars import message_to_attitude
from starpos_common.messages import unix_to_stamp
from starpos_interfaces.msg import Attitude, Solution
from starpos_testing.graph.graph import stamp_of
from starpos_testing.graph.shots import SOLVER, START_S, shot_of
from starpos_testing.skies.scenes import wide_scene

RATE_DEG_S, APART_S = 10.0, 0.5
GYRO = ("gyro:=true", "tilt_timeout:=0.0", "qos_overrides./imu/data.subscription.reliability:=reliable")


@pytest.fixture(scope="module")
def turning(graph, tmp_path_factory):
    """A solver with a gyro: who feeds it readings, and the attitudes that it publishes."""
    graph.start(tmp_path_factory.mktemp("solver") / "log", "starpos_solver", "solver", *SOLVER, *GYRO)
    graph.wait_for_solver()
    attitudes = graph.hear(Attitude, "attitude")
    readings = graph.node.create_publisher(Imu, "imu/data", QoSProfile(depth=1000))
    graph.wait(
        lambda: readings.get_subscription_count() == 1 and graph.node.count_publishers("attitude") == 1
    )
    return readings, attitudes


def shots_of_a_turn(begin_s, count, rng):
    """Frames without tilts of a camera that looks up and turns to the left."""
    turn_deg = RATE_DEG_S * APART_S
    shots = [
        shot_of(wide_scene(pointing_deg=(40.0 - turn_deg * k, 89.99, 0.0)), begin_s + APART_S * k, rng)
        for k in range(count)
    ]
    for shot in shots:
        shot.tilts.clear()
    return shots


def few(shot, rng):
    """The shot with four of its stars under four false ones."""
    stars, brightest = shot.stars.stars, shot.stars.stars[0].flux
    false = [deepcopy(stars[0]) for _ in range(4)]
    for k, star in enumerate(false):
        star.x, star.y = rng.uniform(20, [shot.stars.width - 20, shot.stars.height - 20])
        star.flux = brightest * (9 - k)
    shot.stars.stars = [*false, *(stars[k] for k in (0, 3, 6, 9))]
    return shot


def reading(unix_s, rate_deg_s):
    rate = Vector3(z=float(np.radians(rate_deg_s)))
    return Imu(header=Header(stamp=unix_to_stamp(unix_s)), angular_velocity=rate)


def attitude_of(graph, attitudes, shot):
    """The attitude of a frame, which has no fix."""
    solution, _, _ = graph.answer(shot)
    assert solution.status == Solution.NO_TILT
    graph.wait(lambda: shot.stamp in map(stamp_of, attitudes), "for the attitude")
    return next(message_to_attitude(m) for m in attitudes if stamp_of(m) == shot.stamp)


def test_a_frame_of_few_stars_has_an_attitude_by_the_gyro_and_none_without(graph, turning):
    readings, attitudes = turning
    rng = np.random.default_rng(5)
    shots = shots_of_a_turn(START_S, 4, rng)
    graph.send(shots[0])
    graph.wait(lambda: shots[0].stamp in map(stamp_of, attitudes), "for the triangles and the first attitude")
    for t in np.arange(START_S, START_S + 4 * APART_S, 0.01):
        readings.publish(reading(t, RATE_DEG_S))
    # it is read after them
    readings.publish(reading(START_S + 10.0, np.nan))
    graph.state("solver: Inputs", "an inertial reading is NaN")
    for shot in shots[:2]:
        attitude_of(graph, attitudes, shot)
    seen = attitude_of(graph, attitudes, few(shots[2], rng))
    # all stars are there, and the camera is turned on
    whole = attitude_of(graph, attitudes, shots[3])
    turn = Rotation.from_matrix(whole.camera_to_gcrs.T @ seen.camera_to_gcrs).as_rotvec()
    assert np.degrees(np.linalg.norm(turn)) == pytest.approx(RATE_DEG_S * APART_S, abs=0.2)

    assert graph.call(Trigger, "solver/reset", Trigger.Request()).success
    lost, after = shots_of_a_turn(START_S + 60.0, 2, rng)
    graph.answer(few(lost, rng))
    # what comes after it is heard after it
    attitude_of(graph, attitudes, after)
    assert lost.stamp not in map(stamp_of, attitudes)

# SPDX-License-Identifier: Apache-2.0
"""A computer whose clock was ahead and is set right, and what came in between."""

from dataclasses import replace

import numpy as np
import pytest
from rclpy.qos import QoSProfile
from rosgraph_msgs.msg import Clock

from starpos.messages.stamp import stamp_to_unix
from starpos_common.messages import unix_to_stamp
from starpos_interfaces.msg import Solution
from starpos_testing.graph.shots import EXPOSURE_S, SOLVER, START_S, scene_at, shot_of

AHEAD_S, LATENCY_S = 2.3, 0.5


@pytest.fixture
def clock(graph, tmp_path):
    """Sets the clock of a solver."""
    publisher = graph.node.create_publisher(Clock, "/clock", QoSProfile(depth=1))
    graph.start(tmp_path / "log", "starpos_solver", "solver", "use_sim_time:=true", *SOLVER)
    graph.wait_for_solver()
    graph.wait(publisher.get_subscription_count)
    return lambda unix_s: publisher.publish(Clock(clock=unix_to_stamp(unix_s)))


def test_its_tilts_are_not_those_of_a_frame_whose_stars_come_first(graph, clock):
    rng, scene = np.random.default_rng(3), scene_at()

    def answered(shot):
        solution, _, _ = graph.answer(shot)
        assert solution.status == Solution.OK, solution.status_text

    def shown(start_s, scene=scene, ahead_s=0.0):
        clock(START_S + start_s + EXPOSURE_S + LATENCY_S + ahead_s)
        shot = shot_of(scene, START_S + start_s, rng)
        for m in (shot.stars, *shot.tilts):
            m.header.stamp = unix_to_stamp(stamp_to_unix(m.header.stamp) + ahead_s)
        return shot

    answered(shown(0.0))
    # Its tilts are of 3.15 to 3.55 s.
    answered(shown(0.8, ahead_s=AHEAD_S))
    answered(shown(1.6))
    turned = replace(scene, altitude_deg=scene.altitude_deg + 3.0)
    shot = shown(3.12, turned)
    graph.stars.publish(shot.stars)
    assert not graph.comes(lambda: shot.stamp in graph.solutions, 0.2)
    for tilt in shot.tilts:
        graph.tilt.publish(tilt)
    solution, _, _ = graph.result(shot.stamp)
    assert (solution.tilt.x, solution.tilt.y) == pytest.approx(turned.tilt, abs=1e-4)


def test_a_frame_of_another_time_gets_no_fix_from_the_tilts_of_that_time(graph, clock):
    """Its stars have overtaken its own tilts, and then the instrument leaned otherwise."""
    rng, scene = np.random.default_rng(4), scene_at()
    turned = replace(scene, altitude_deg=scene.altitude_deg + 3.0)

    def exposed(start_s, scene):
        clock(START_S + start_s + EXPOSURE_S + LATENCY_S)
        return shot_of(scene, START_S + start_s, rng)

    for start_s, leaning in ((0.0, scene), (0.8, scene), (40.0, turned), (40.8, turned)):
        solution, _, _ = graph.answer(exposed(start_s, leaning))
        assert solution.status == Solution.OK, solution.status_text
    shot = exposed(41.6, turned)
    shot.stars.header.stamp = unix_to_stamp(stamp_to_unix(shot.stars.header.stamp) - 40.78)
    graph.stars.publish(shot.stars)
    solution, fix, _ = graph.result(shot.stamp)
    assert solution.status == Solution.NO_TILT and "of another time" in solution.status_text
    assert fix.status.status < 0
    solution, _, _ = graph.answer(exposed(42.4, turned))
    assert solution.status == Solution.OK, solution.status_text

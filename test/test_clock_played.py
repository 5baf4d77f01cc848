# SPDX-License-Identifier: Apache-2.0
"""A clock that is played on /clock may be read after what it dates; what is ahead of it all the same is not used."""

from dataclasses import replace

import numpy as np
import pytest
from rclpy.qos import QoSProfile
from rosgraph_msgs.msg import Clock

from starpos_common.messages import unix_to_stamp
from starpos_interfaces.msg import Solution
from starpos_testing.graph.shots import EXPOSURE_S, SOLVER, START_S, scene_at, shot_of

LATENCY_S, TICK_S = 0.5, 0.1


class Played:
    """A solver whose time is played, and an instrument."""

    def __init__(self, graph, clock):
        self.graph, self._clock, self._rng, self.scene = graph, clock, np.random.default_rng(5), scene_at()

    def shot(self, at_s: float):
        return shot_of(self.scene, START_S + at_s, self._rng)

    def answer(self, at_s: float, stars) -> Solution:
        """The solution of stars; /clock, which may lose messages, ticks about `at_s` until it has come."""
        stamp, ticks = (stars.header.stamp.sec, stars.header.stamp.nanosec), iter(range(10**6))
        self.graph.stars.publish(stars)

        def answered():
            now_s = START_S + at_s + EXPOSURE_S + LATENCY_S + TICK_S * next(ticks)
            self._clock.publish(Clock(clock=unix_to_stamp(now_s)))
            return stamp in self.graph.solutions

        self.graph.wait(answered, "for a solution")
        return self.graph.solutions[stamp][-1]

    def tilts(self, shot):
        for tilt in shot.tilts:
            self.graph.tilt.publish(tilt)


@pytest.fixture
def played(graph, run):
    clock = graph.node.create_publisher(Clock, "/clock", QoSProfile(depth=1))
    run("starpos_solver", "solver", "use_sim_time:=true", "tilt_timeout:=2.0", *SOLVER)
    graph.wait(lambda: all(p.get_subscription_count() for p in (graph.info, graph.stars, graph.tilt, clock)))
    graph.solutions.clear()
    played = Played(graph, clock)
    shot = played.shot(0.0)
    graph.info.publish(shot.info)
    played.tilts(shot)
    assert played.answer(0.0, shot.stars).status == Solution.OK
    yield played
    graph.node.destroy_publisher(clock)


def test_tilts_and_stars_that_are_read_before_their_clock_make_a_fix(played):
    shot = played.shot(20.0)
    played.tilts(shot)
    # the clock of 20 s comes after them
    assert played.answer(20.0, shot.stars).status == Solution.OK


def test_tilts_ahead_of_the_clock_are_not_used_when_their_time_comes(played):
    """The inclinometer's clock is ahead by 5 s: 315 wrong checks in 15 such faults where 11 s ahead were let through."""
    later = played.shot(25.0)
    played.tilts(later)
    for at_s in (20.0, 20.8):
        assert played.answer(at_s, played.shot(at_s).stars).status == Solution.NO_TILT
    played.scene = replace(played.scene, altitude_deg=played.scene.altitude_deg + 3.0)
    assert played.answer(25.0, played.shot(25.0).stars).status == Solution.NO_TILT

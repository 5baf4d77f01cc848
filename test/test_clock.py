# SPDX-License-Identifier: Apache-2.0
"""What is known of the time of a frame goes into its fix and into /diagnostics."""

import math
import time

import pytest
from shots import LATITUDE_DEG, shoot

from starpos_common.messages import unix_to_stamp
from starpos_interfaces.msg import Solution

OK, WARN = b"\x00", b"\x01"
METRES_PER_S = 465.1 * math.cos(math.radians(LATITUDE_DEG))


def told(clock=0.0, stamp=0.0):
    shot = shoot()
    shot.stars.clock_stddev, shot.stars.stamp_stddev = clock, stamp
    return shot


def of_budget(solution, name: str) -> float:
    """Seconds that the term says of the time."""
    return next(t.east for t in solution.budget if t.name == name) / METRES_PER_S


def answered(graph, shot) -> Solution:
    solution, _, _ = graph.answer(shot)
    assert solution.status == Solution.OK, solution.status_text
    return solution


def test_a_clock_that_nothing_keeps_makes_a_wide_fix_and_a_warning(graph, solver):
    solution = answered(graph, told(clock=16.0, stamp=0.2))
    assert of_budget(solution, "clock") == pytest.approx(16, rel=0.01)
    assert of_budget(solution, "time stamp") == pytest.approx(0.2, rel=0.01)
    assert solution.covariance[0] > (15 * METRES_PER_S) ** 2
    state = graph.state("solver: Clock", "synchronise the camera's clock")
    assert state.level == WARN and {v.key: v.value for v in state.values}["clock sigma (s)"] == "16"


def test_a_host_that_trusts_its_clock_more_than_the_instrument_does_not_narrow_the_fix(graph, solver):
    assert of_budget(answered(graph, told(clock=1e-6)), "clock") == pytest.approx(0.01, rel=0.01)
    assert graph.state("solver: Clock", "the time is known to 0.01 s").level == OK


def test_who_sets_clock_stddev_knows_better(graph, solver):
    assert graph.set("solver", clock_stddev=0.002)[0]
    try:
        assert of_budget(answered(graph, told(clock=16.0)), "clock") == pytest.approx(0.002, rel=0.01)
    finally:
        assert graph.set("solver", clock_stddev=math.nan)[0]
    assert of_budget(answered(graph, told(clock=16.0)), "clock") == pytest.approx(16, rel=0.01)


@pytest.mark.parametrize("value", [math.nan, math.inf, -1e-3])
def test_a_clocks_error_that_is_none_is_refused(graph, solver, value):
    solution, _, _ = graph.answer(told(clock=value))
    assert solution.status == Solution.BAD_INPUT and "clock_stddev_s" in solution.status_text


def test_frames_from_the_future_are_said(graph, solver):
    shot = shoot()
    shot.stars.header.stamp = unix_to_stamp(time.time() + 100)
    graph.send(shot)
    state = graph.state("solver: Clock", "before their time")
    assert (
        state.level == WARN and 90 < -float({v.key: v.value for v in state.values}["frame age (s)"]) < 100.5
    )

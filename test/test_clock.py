# SPDX-License-Identifier: Apache-2.0
"""What is known of the time of a frame goes into its fix and into /diagnostics."""

import math
import time

import pytest
from sensor_msgs.msg import NavSatFix
from std_srvs.srv import Trigger

from starpos.messages.stamp import stamp_to_unix
from starpos_common.messages import unix_to_stamp
from starpos_interfaces.msg import Solution
from starpos_interfaces.srv import Solve
from starpos_testing.graph.graph import stamp_of
from starpos_testing.graph.shots import LATITUDE_DEG, shoot

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


def test_what_the_stars_say_of_their_shutter_is_in_the_budget(graph, solver):
    def claimed_m(**shutter):
        shot = told()
        for name, value in shutter.items():
            setattr(shot.stars, name, value)
        (term,) = (t for t in answered(graph, shot).budget if t.name == "shutter")
        assert term.common
        return math.hypot(term.east, term.north)

    unknown = claimed_m(shutter_known=False)
    assert claimed_m(shutter_known=True) == 0
    # each shot sees other stars
    assert claimed_m(shutter_known=True, readout_stddev=0.06) == pytest.approx(2 * unknown, rel=0.4) != 0


@pytest.mark.parametrize("value", [math.nan, math.inf, 1e3])
def test_a_readout_that_is_none_is_refused(graph, solver, value):
    shot = told()
    shot.stars.shutter_known, shot.stars.readout = True, value
    solution, _, _ = graph.answer(shot)
    assert solution.status == Solution.BAD_INPUT and "readout" in solution.status_text


def late(shot, seconds):
    """The shot's stamps moved."""
    for m in (shot.stars, *shot.tilts):
        m.header.stamp = unix_to_stamp(stamp_to_unix(m.header.stamp) + seconds)
    return shot


def test_a_frame_that_comes_late_does_not_begin_the_average_anew(graph, solver):
    averaged = graph.hear(NavSatFix, "fix_averaged")
    assert graph.call(Trigger, "solver/reset", Trigger.Request()).success
    shots = [shoot() for _ in range(6)]
    for shot in (*shots[:4], shots[5], shots[4]):
        answered(graph, shot)
    values = {v.key: v.value for v in graph.state("solver: Average", "of all frames here").values}
    assert values["frames"] == "5"
    graph.wait(lambda: shots[5].stamp in map(stamp_of, averaged), "for the average of the newest frame")
    assert stamp_of(averaged[-1]) == shots[5].stamp


def test_a_stamp_that_the_stars_contradict_makes_a_wide_fix(graph, solver):
    averaged = graph.hear(NavSatFix, "fix_averaged")
    assert graph.call(Trigger, "solver/reset", Trigger.Request()).success
    for _ in range(3):
        answered(graph, told())
    shot = late(told(), -3.0)
    solution = answered(graph, shot)
    assert of_budget(solution, "clock") == pytest.approx(3.0, rel=0.02)
    assert abs(shot.error_m(solution)[0]) < 2 * solution.covariance[0] ** 0.5
    state = graph.state("solver: Clock", "a clock was set")
    assert state.level == WARN
    assert graph.call(Solve, "solver/solve", Solve.Request()).solution.covariance[0] > 1e6
    assert of_budget(answered(graph, told()), "clock") == pytest.approx(0.01, rel=0.01)
    assert shot.stamp not in {stamp_of(m) for m in averaged}


def test_a_clock_that_was_set_is_believed_again_when_somebody_says_so(graph, solver):
    assert graph.call(Trigger, "solver/reset", Trigger.Request()).success
    for _ in range(3):
        answered(graph, told())
    for _ in range(3):
        assert of_budget(answered(graph, late(told(), 5.0)), "clock") == pytest.approx(5.0, rel=0.02)
    assert graph.call(Trigger, "solver/reset", Trigger.Request()).success
    assert of_budget(answered(graph, late(told(), 5.0)), "clock") == pytest.approx(0.01, rel=0.01)
    assert graph.call(Trigger, "solver/reset", Trigger.Request()).success


def test_frames_and_tilts_from_the_future_are_refused(graph, solver):
    shot = shoot()
    late(shot, time.time() + 100 - stamp_to_unix(shot.stars.header.stamp))
    graph.send(shot)
    assert graph.result(stamp_of(shot.stars))[0].status == Solution.BAD_INPUT
    graph.wait(lambda: "a tilt is stamped" in solver.output, "for a word on the tilts")
    shot = shoot()
    late(shot, time.time() + 2.0 - stamp_to_unix(shot.stars.header.stamp))
    graph.send(shot)
    solution, _, _ = graph.result(stamp_of(shot.stars))
    assert solution.status == Solution.BAD_INPUT and "in the future" in solution.status_text
    answer = graph.call(Solve, "solver/solve", Solve.Request())
    assert not answer.success and "in the future" in answer.message
    # What the clock's stated error allows is used.
    shot = shoot()
    late(shot, time.time() + 100 - stamp_to_unix(shot.stars.header.stamp))
    shot.tilts.clear()
    shot.stars.clock_stddev = 60.0
    graph.send(shot)
    assert graph.result(stamp_of(shot.stars))[0].status == Solution.NO_TILT
    # A night that is played, of another time.
    shot = shoot()
    assert graph.call(Trigger, "solver/reset", Trigger.Request()).success
    late(shot, time.time() + 30 * 86400 - stamp_to_unix(shot.stars.header.stamp))
    graph.send(shot)
    assert graph.result(stamp_of(shot.stars))[0].status == Solution.OK
    assert graph.state("solver: Clock", "the time is known").level == OK
    assert graph.call(Trigger, "solver/reset", Trigger.Request()).success
    shot = shoot()
    late(shot, time.time() + 100 - stamp_to_unix(shot.stars.header.stamp))
    graph.send(shot)
    state = graph.state("solver: Clock", "in the future")
    assert (
        state.level == WARN and 90 < -float({v.key: v.value for v in state.values}["frame age (s)"]) < 100.5
    )

# SPDX-License-Identifier: Apache-2.0
"""Tilts as a network delivers them, and a solver that is killed in the middle of the night."""

import signal
from copy import deepcopy
from dataclasses import replace

import pytest
from std_srvs.srv import Trigger

from starpos_interfaces.msg import Solution
from starpos_interfaces.srv import Solve
from starpos_testing.graph.shots import SOLVER, shoot

ANSWER = (
    "latitude",
    "longitude",
    "heading",
    "heading_stddev",
    "covariance",
    "residual",
    "ids",
    "tilt_samples",
)


def told(solution) -> list:
    """What an answer says, for a comparison to the last bit."""
    return [list(v) if hasattr(v := getattr(solution, name), "__len__") else v for name in ANSWER]


def forget(graph, shot):
    assert graph.call(Trigger, "solver/reset", Trigger.Request()).success
    graph.solutions.pop(shot.stamp, None)


def answer_of_all(graph, shot):
    """The solution of a shot with all its tilts: under load the first one may come before the last tilts."""
    graph.answer(shot)
    solutions = []

    def whole():
        solutions.append(graph.call(Solve, "solver/solve", Solve.Request()).solution)
        return solutions[-1].tilt_samples == len(shot.tilts)

    graph.wait(whole, "for all tilts of the exposure")
    return solutions[-1]


def check_same_answer(graph, shot, tilts, expected):
    """Check that these tilts instead, after a reset, give the same answer to the last bit once they all are there."""
    forget(graph, shot)
    graph.send(replace(shot, tilts=tilts))
    graph.result(shot.stamp)

    def solve():
        return told(graph.call(Solve, "solver/solve", Solve.Request()).solution)

    # nothing orders tilts and stars, nor what comes out of order: the first answer may be of fewer
    graph.wait(lambda: solve() == told(expected), "for the same answer")


def others(shot, seconds):
    """Its tilts as of another moment, and of another instrument: they must not be used."""
    moved = deepcopy(shot.tilts)
    for tilt in moved:
        tilt.header.stamp.sec += seconds
        tilt.x += 0.01
    return moved


def test_the_order_of_tilts_and_doubled_ones_do_not_matter(graph, solver):
    shot = shoot()
    solution = answer_of_all(graph, shot)
    assert solution.status == Solution.OK
    a, b, c, d, e = shot.tilts
    for tilts in ([e, c, a, d, b], [a, a, b, b, c, c, d, d, e, e], [c, b, a, c, b, a, d, e, d]):
        check_same_answer(graph, shot, tilts, solution)


@pytest.mark.parametrize("seconds", [60, 86400 * 365])
def test_tilts_of_a_clock_that_jumps_ahead_do_not_matter(graph, solver, seconds):
    shot = shoot()
    solution = answer_of_all(graph, shot)
    mixed = [t for pair in zip(others(shot, seconds), shot.tilts, strict=True) for t in pair]
    check_same_answer(graph, shot, mixed, solution)


def test_tilts_of_a_minute_before_do_not_matter(graph, solver):
    shot = shoot()
    solution = answer_of_all(graph, shot)
    check_same_answer(graph, shot, others(shot, -60) + shot.tilts, solution)


def test_tilts_before_an_earlier_one_are_of_a_clock_ahead_and_none(graph, solver):
    """Back by a minute and ahead again: each earlier sample shows that the later ones before it were stamped ahead."""
    shot = shoot()
    mixed = [t for pair in zip(shot.tilts, others(shot, -60), strict=True) for t in pair]
    graph.send(replace(shot, tilts=mixed))
    assert graph.result(shot.stamp)[0].status == Solution.NO_TILT


def test_a_frame_waits_for_its_last_tilts(graph, solver):
    shot = shoot()
    solution = answer_of_all(graph, shot)
    graph.set("solver", tilt_timeout=20.0)
    forget(graph, shot)
    *early, last = shot.tilts
    graph.stars.publish(shot.stars)
    for tilt in early:
        graph.tilt.publish(tilt)
    assert not graph.comes(lambda: shot.stamp in graph.solutions, 1.0)
    graph.tilt.publish(last)
    assert told(graph.result(shot.stamp)[0]) == told(solution)
    graph.set("solver", tilt_timeout=0.5)


def test_tilts_that_come_too_late_are_none_and_solve_takes_them(graph, solver):
    shot = shoot()
    graph.info.publish(shot.info)
    graph.stars.publish(shot.stars)
    assert graph.result(shot.stamp)[0].status == Solution.NO_TILT
    for tilt in shot.tilts:
        graph.tilt.publish(tilt)
    graph.wait(lambda: graph.call(Solve, "solver/solve", Solve.Request()).success)


def test_a_solver_that_was_killed_answers_as_before(graph, solver, tmp_path):
    shot = shoot()
    before = answer_of_all(graph, shot)
    solver.signal(signal.SIGKILL)
    solver.wait()
    graph.processes.remove(solver)
    graph.solutions.clear()
    graph.start(tmp_path / "log", "starpos_solver", "solver", *SOLVER)

    def answered():
        # the dead one stays in the graph until its lease of 20 s is over, so there is no other sign of the new one
        graph.send(shot)
        return graph.comes(
            lambda: any(told(s) == told(before) for s in graph.solutions.get(shot.stamp, ())), 1.0
        )

    graph.wait(answered, "for the fix of before from the new solver")

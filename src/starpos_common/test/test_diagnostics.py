# SPDX-License-Identifier: Apache-2.0
"""What arrives on /diagnostics."""

import time

import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus

from starpos_common.diagnostics import Diagnosis, Diagnostics, Level
from starpos_testing.nodes import take_domain
from starpos_testing.patience import WAIT_S


@pytest.fixture
def node():
    take_domain()
    context = rclpy.Context()
    rclpy.init(context=context)
    node = rclpy.create_node("sensor", context=context)
    yield node
    node.destroy_node()
    rclpy.shutdown(context=context)


def broken():
    raise ValueError("no number")


def test_levels_are_those_of_the_message():
    for level in Level:
        assert getattr(DiagnosticStatus, level.name) == bytes([level])


def test_every_task_is_published_each_second_even_in_paused_simulated_time(node):
    node.set_parameters([rclpy.Parameter("use_sim_time", value=True)])
    tasks = {
        "Link": lambda: Diagnosis(Level.WARN, "weak", {"rate (Hz)": 9.5, "port": "/dev/x", "lost": 3}),
        "Clock": broken,
    }
    diagnostics = Diagnostics(node, tasks, "unit 7")
    received = []
    node.create_subscription(DiagnosticArray, "/diagnostics", received.append, 10)
    executor = rclpy.executors.SingleThreadedExecutor(context=node.context)
    executor.add_node(node)
    end = time.monotonic() + WAIT_S
    while len(received) < 2:
        assert time.monotonic() < end
        executor.spin_once(timeout_sec=0.5)
    link, clock = received[-1].status
    assert (link.name, link.level, link.message) == ("sensor: Link", DiagnosticStatus.WARN, "weak")
    assert link.hardware_id == "unit 7"
    assert {v.key: v.value for v in link.values} == {"rate (Hz)": "9.5", "port": "/dev/x", "lost": "3"}
    assert clock.level == DiagnosticStatus.ERROR and "no number" in clock.message
    before = len(received)
    diagnostics.publish()
    while len(received) == before:
        assert time.monotonic() < end
        executor.spin_once(timeout_sec=0.5)


def test_the_same_node_of_two_instruments_has_two_names(node):
    received = []
    node.create_subscription(DiagnosticArray, "/diagnostics", received.append, 10)
    executor = rclpy.executors.SingleThreadedExecutor(context=node.context)
    executor.add_node(node)
    twins = [rclpy.create_node("solver", context=node.context, namespace=ns) for ns in ("a", "/b/c", "")]
    for twin in twins:
        Diagnostics(twin, {"Solution": lambda: Diagnosis(Level.OK, "")})
        executor.add_node(twin)
    wanted = {"/a/solver: Solution", "/b/c/solver: Solution", "solver: Solution"}
    end = time.monotonic() + WAIT_S
    while not wanted <= {message.status[0].name for message in received}:
        assert time.monotonic() < end, received
        executor.spin_once(timeout_sec=0.5)
    for twin in twins:
        twin.destroy_node()

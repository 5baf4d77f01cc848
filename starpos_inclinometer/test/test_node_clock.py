# SPDX-License-Identifier: Apache-2.0
"""The node itself, in this process, while the host's clock is stepped: what it publishes, logs and reports."""

import time
from itertools import pairwise

import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.executors import SingleThreadedExecutor

from starpos_inclinometer.node import InclinometerNode
from starpos_interfaces.msg import Tilt
from starpos_testing.emulator import Mcu
from starpos_testing.nodes import take_domain
from starpos_testing.patience import WAIT_S


@pytest.fixture
def spin(bench):
    """A node on the bench's port; spins it until a condition holds."""
    take_domain()
    bench.plug(Mcu(seed=1))
    rclpy.init(args=["--ros-args", "-p", f"port:={bench.path}", "-p", "rate:=50"])
    node, executor = InclinometerNode(), SingleThreadedExecutor()
    executor.add_node(node)

    def until(condition):
        end = time.monotonic() + WAIT_S
        while not condition():
            assert time.monotonic() < end
            executor.spin_once(timeout_sec=0.5)

    until.node = node
    yield until
    executor.shutdown()
    node.close()
    node.destroy_node()
    rclpy.try_shutdown()


def test_a_step_is_in_the_stamps_one_line_of_the_log_and_the_diagnostics(spin, capfd):
    tilts, levels = [], []
    spin.node.create_subscription(Tilt, "tilt", tilts.append, 100)
    spin.node.create_subscription(
        DiagnosticArray, "/diagnostics", lambda m: levels.extend((s.level, s.message) for s in m.status), 10
    )
    spin(lambda: len(tilts) >= 30 and any(level == b"\x00" for level, _ in levels))
    real = spin.node.host_clock.now_ns
    spin.node.host_clock.now_ns = lambda: real() - 2_000_000_000
    levels.clear()
    spin(lambda: sum(level == b"\x01" and "-2.0" in text for level, text in levels) >= 2)
    stamps = [t.header.stamp.sec + t.header.stamp.nanosec * 1e-9 for t in tilts]
    # a line that comes sooner than those before it, on a busy machine, corrects some ms
    back = [b - a for a, b in pairwise(stamps) if b < a - 0.1]
    assert len(back) == 1 and back[0] == pytest.approx(-1.98, abs=0.05)
    assert [b.sequence - a.sequence for a, b in pairwise(tilts)] == [1] * (len(tilts) - 1)
    out, err = capfd.readouterr()
    assert (out + err).count("was stepped by") == 1

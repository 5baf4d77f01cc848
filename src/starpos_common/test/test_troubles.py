# SPDX-License-Identifier: Apache-2.0
"""A fault that lasts is a line in the log when it begins and one when it is over."""

import pytest
import rclpy

from starpos_common import diagnostics
from starpos_common.diagnostics import MAX_KINDS, QUIET_S, Troubles
from starpos_testing.nodes import take_domain


@pytest.fixture
def clock(monkeypatch):
    now = [100.0]
    monkeypatch.setattr(diagnostics.time, "monotonic", lambda: now[0])
    return now


@pytest.fixture
def told():
    take_domain()
    context = rclpy.Context()
    rclpy.init(context=context)
    node = rclpy.create_node("troubles", context=context)
    yield Troubles(node)
    node.destroy_node()
    rclpy.shutdown(context=context)


def test_one_line_when_it_begins_and_one_when_it_is_over(told, clock, capfd):
    for k in range(1000):
        clock[0] += 0.1
        told.wrong("tilt", f"a tilt is {k}.5 s early")
        # Every other one.
        told.right("tilt")
    assert capfd.readouterr().err.count("\n") == 1
    assert told.lately(5.0) == ["a tilt is 999.5 s early"]
    # Another reason.
    told.wrong("tilt", "a tilt has no stamp")
    assert "has no stamp" in capfd.readouterr().err
    clock[0] += QUIET_S + 0.1
    assert told.lately(5.0) == []
    told.right("tilt"), told.right("tilt")
    assert capfd.readouterr().err.count("tilt: in order again") == 1
    told.wrong("tilt", "a tilt has no stamp")
    assert capfd.readouterr().err.count("has no stamp") == 1


def test_words_from_outside_do_not_flood_the_log(told, clock, capfd):
    for k in range(1000):
        told.wrong("frames", f"the encoding {'abcdefghijkl'[k % 12] * (k % 7 + 1)} is unknown")
    assert capfd.readouterr().err.count("\n") == MAX_KINDS

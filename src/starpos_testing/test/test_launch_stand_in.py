# SPDX-License-Identifier: Apache-2.0
"""What stands in for launch refuses what it does not know: a launch file that uses it fails, and does not pass."""

import sys
from importlib.util import find_spec

import pytest

from starpos_testing import launch_stand_in
from starpos_testing.launch_stand_in import (
    ExecuteProcess,
    GroupAction,
    LaunchContext,
    Node,
    modules,
    normalized,
)


@pytest.mark.skipif(find_spec("launch_ros") is not None, reason="launch_ros is installed here")
@pytest.mark.parametrize(
    "line",
    ["from launch.actions import TimerAction", "import launch.events", "from launch_ros import descriptions"],
)
def test_a_name_that_is_not_there_is_not_imported(line, monkeypatch):
    for name, module in modules().items():
        monkeypatch.setitem(sys.modules, name, module)
    exec("from launch.actions import ExecuteProcess")
    with pytest.raises(ImportError):
        exec(line)


def test_where_launch_is_installed_nothing_stands_in(monkeypatch):
    monkeypatch.setattr(launch_stand_in, "find_spec", lambda name: name)
    assert modules() == {}


@pytest.mark.parametrize(
    "made",
    [
        lambda: Node(package="starpos_solver", executable="solver", remappings=[("fix", "gps")]),
        lambda: Node(package="starpos_solver", executable="solver", name="mine"),
        lambda: Node(package="starpos_solver", executable="solver", arguments=[1.5]),
        lambda: ExecuteProcess(cmd=["true"], shell=True),
        lambda: GroupAction([], scoped=False),
        lambda: normalized(["a", None]),
    ],
)
def test_a_keyword_or_a_value_that_it_does_not_know_is_refused(made):
    with pytest.raises(TypeError):
        made()


def test_it_starts_nothing():
    with pytest.raises(NotImplementedError, match="executes no ExecuteProcess"):
        ExecuteProcess(cmd=["true"]).visit(LaunchContext())

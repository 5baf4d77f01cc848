# SPDX-License-Identifier: Apache-2.0
"""The launch file, where launch is installed: it is no part of the ROS that PyPI carries."""

import importlib.util
from pathlib import Path

import pytest

LAUNCH_FILE = Path(__file__).parent.parent / "launch" / "starpos.launch.py"


def test_the_launch_file_starts_the_four_nodes_and_takes_its_arguments():
    pytest.importorskip("launch_ros", reason="ros2/launch_ros is not installed here")
    import launch

    spec = importlib.util.spec_from_file_location("starpos_launch", LAUNCH_FILE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    description = module.generate_launch_description()
    arguments = {e.name for e in description.entities if isinstance(e, launch.actions.DeclareLaunchArgument)}
    assert arguments == {"namespace", "params_file", "use_sim_time", "camera", "port", "log_level"}
    started = [e.node_executable for e in description.entities if hasattr(e, "node_executable")]
    assert started == ["camera", "detector", "inclinometer", "solver"]

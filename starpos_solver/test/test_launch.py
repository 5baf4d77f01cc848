# SPDX-License-Identifier: Apache-2.0
"""The launch file, where launch is installed: it is no part of the ROS that PyPI carries."""

import importlib.util
from pathlib import Path

import pytest

LAUNCH_FILE = Path(__file__).parent.parent / "launch" / "starpos.launch.py"


@pytest.fixture
def launch_file():
    pytest.importorskip("launch_ros", reason="ros2/launch_ros is not installed here")
    spec = importlib.util.spec_from_file_location("starpos_launch", LAUNCH_FILE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def started(module, **given) -> dict[str, list]:
    """Parameters of each executable as launch would pass them."""
    import launch

    context = launch.LaunchContext()
    description = module.generate_launch_description()
    for entity in description.entities:
        if isinstance(entity, launch.actions.DeclareLaunchArgument):
            context.launch_configurations[entity.name] = given.get(entity.name, "")
    return {n.node_executable: n._Node__parameters for n in module.nodes(context)}


def test_it_starts_the_four_nodes_and_takes_its_arguments(launch_file):
    names = {name for name, _, _ in launch_file.ARGUMENTS}
    assert names == {"namespace", "params_file", "use_sim_time", "camera", "port", "log_level"}
    assert list(started(launch_file, params_file="mine.yaml")) == [
        "camera",
        "detector",
        "inclinometer",
        "solver",
    ]


def test_only_arguments_that_are_given_override_the_parameter_file(launch_file):
    silent = started(launch_file, params_file="mine.yaml")
    assert all(len(parameters) == 1 or not parameters[1] for parameters in silent.values())
    told = started(launch_file, params_file="mine.yaml", port="/dev/x", use_sim_time="true")
    assert len(told["inclinometer"][1]) == 2 and len(told["camera"][1]) == 1

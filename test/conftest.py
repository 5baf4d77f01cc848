# SPDX-License-Identifier: Apache-2.0
"""A ROS domain of this session's own, the graph's other end, and a solver that a file's tests share."""

from pathlib import Path

import pytest

from starpos_testing.graph.graph import Graph
from starpos_testing.graph.shots import SOLVER
from starpos_testing.graph.tf2_messages import built
from starpos_testing.nodes import take_domain

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="session", autouse=True)
def domain():
    take_domain()


@pytest.fixture(scope="module")
def graph(domain):
    graph = Graph()
    yield graph
    graph.close()


@pytest.fixture
def run(graph, tmp_path):
    """Start an executable that ends with the test: run(package, name, *parameters, arguments=())."""
    mine = []

    def run(package, name, *parameters, arguments=()):
        log = tmp_path / f"{len(mine)}-{name}.log"
        mine.append(graph.start(log, package, name, *parameters, arguments=arguments))
        return mine[-1]

    yield run
    for process in mine:
        process.end()
        if process in graph.processes:
            graph.processes.remove(process)


@pytest.fixture(scope="module")
def solver(graph, tmp_path_factory):
    """A solver that knows the air of the shots, for all tests of a file."""
    process = graph.start(tmp_path_factory.mktemp("solver") / "log", "starpos_solver", "solver", *SOLVER)
    graph.wait_for_solver()
    return process


@pytest.fixture(scope="session")
def variables_of_tf2():
    return built(ROOT / "build" / "tf2_msgs")


@pytest.fixture
def tf2(variables_of_tf2, monkeypatch):
    """Nodes that are started have the package tf2_msgs, as on a robot."""
    for name, value in variables_of_tf2.items():
        monkeypatch.setenv(name, value)

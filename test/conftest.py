# SPDX-License-Identifier: Apache-2.0
"""A ROS domain of this session's own, the graph's other end, and a solver that a file's tests share."""

import gc
import json
import subprocess
import sys
from pathlib import Path

import pytest

from starpos_testing.graph.graph import Graph
from starpos_testing.graph.shots import SOLVER
from starpos_testing.graph.tf2_messages import built
from starpos_testing.nodes import take_domain
from starpos_testing.prepared import forked

ROOT = Path(__file__).parents[1]
# a process of its own, as the test's has no tf2_msgs: a line for each transform
LISTEN = """
import json, sys, rclpy
from rclpy.qos import DurabilityPolicy, QoSProfile
from tf2_msgs.msg import TFMessage
rclpy.init()
node = rclpy.create_node("listener")
def on_message(message):
    for t in message.transforms:
        at, p, q = t.header.stamp, t.transform.translation, t.transform.rotation
        names, numbers = [t.header.frame_id, t.child_frame_id], [p.x, p.y, p.z, q.x, q.y, q.z, q.w]
        print(json.dumps([[at.sec, at.nanosec], names, numbers]), flush=True)
topic, latched = sys.argv[1:]
kept = DurabilityPolicy.TRANSIENT_LOCAL if latched == "latched" else DurabilityPolicy.VOLATILE
node.create_subscription(TFMessage, topic, on_message, QoSProfile(depth=1000, durability=kept))
rclpy.spin(node)
"""


def pytest_collection_finish():
    """Modules and tests stay to the end: the collector need not look at them again and again."""
    gc.collect()
    gc.freeze()


@pytest.fixture(scope="session", autouse=True)
def domain():
    take_domain()


@pytest.fixture(scope="module")
def graph(domain):
    graph = Graph(forked)
    yield graph
    graph.close()


@pytest.fixture
def run(graph, tmp_path):
    """Start an executable that ends with the test: run(package, name, *parameters, arguments=(), start=None)."""
    mine = []

    def run(package, name, *parameters, arguments=(), start=None):
        log = tmp_path / f"{len(mine)}-{name}.log"
        mine.append(graph.start(log, package, name, *parameters, arguments=arguments, start=start))
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


@pytest.fixture
def listen(tf2, tmp_path):
    """Listen to transforms from now on: listen(topic, "latched" or "") returns a function that gives those heard.

    Each is its stamp, the names of parent and child, translation and quaternion.
    """
    listeners = []

    def listen(topic, kind=""):
        heard = tmp_path / f"transforms-{len(listeners)}"
        with heard.open("w") as out:
            listeners.append(subprocess.Popen([sys.executable, "-c", LISTEN, topic, kind], stdout=out))
        return lambda: [json.loads(s) for s in heard.read_text().splitlines(keepends=True) if s[-1] == "\n"]

    yield listen
    for process in listeners:
        process.kill()
        process.wait()

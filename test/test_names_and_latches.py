# SPDX-License-Identifier: Apache-2.0
"""Names that go with the node, and intrinsics from whoever sends them, whenever."""

import pytest
from rclpy.duration import Duration
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import CameraInfo
from std_srvs.srv import Trigger

from starpos_interfaces.msg import Solution
from starpos_testing.graph.shots import SOLVER, shoot
from starpos_testing.patience import WAIT_S

SERVICES = ("calibrate", "reset", "save_calibration", "self_calibrate", "solve")
LATCHED = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)


def services(graph, node: str) -> set[str]:
    own = {name for name, _ in graph.node.get_service_names_and_types_by_node(node, "/")}
    return {name for name in own if name.rsplit("/", 1)[-1] in SERVICES}


def test_two_solvers_have_services_of_their_own(graph, run):
    for name in ("left", "right"):
        run("starpos_solver", "solver", arguments=("--ros-args", "-r", f"__node:={name}"))
    graph.wait(lambda: {"left", "right"} <= set(graph.node.get_node_names()))
    for name in ("left", "right"):
        graph.wait(lambda n=name: services(graph, n) == {f"/{n}/{s}" for s in SERVICES})
        assert graph.call(Trigger, f"/{name}/reset", Trigger.Request()).success


@pytest.fixture
def latched(graph):
    publisher = graph.node.create_publisher(CameraInfo, "camera/camera_info", LATCHED)
    yield publisher
    graph.node.destroy_publisher(publisher)


def test_a_solver_that_starts_later_knows_the_camera_of_a_latched_camera_info(graph, run, latched):
    shot = shoot()
    latched.publish(shot.info)
    run("starpos_solver", "solver", *SOLVER)
    graph.wait(lambda: graph.stars.get_subscription_count() and graph.tilt.get_subscription_count())
    graph.wait(latched.get_subscription_count)
    # else the stars could overtake it
    assert latched.wait_for_all_acked(Duration(seconds=WAIT_S))
    # the stars alone come now
    for tilt in shot.tilts:
        graph.tilt.publish(tilt)
    graph.stars.publish(shot.stars)
    assert graph.result(shot.stamp)[0].status == Solution.OK


def test_a_camera_info_is_taken_from_a_volatile_publisher_too(graph, run):
    solver = run("starpos_solver", "solver", *SOLVER)
    graph.wait_for_solver()
    solution, _, _ = graph.answer(shoot())
    assert solution.status == Solution.OK
    assert "incompatible QoS" not in solver.output


def test_a_latched_camera_info_is_taken_once(graph, run, latched):
    """All three of the solver's subscriptions hear it: a broken one is counted where it is refused."""
    run("starpos_solver", "solver", *SOLVER)
    graph.wait(lambda: latched.get_subscription_count() == 3)
    for _ in range(3):
        latched.publish(CameraInfo())

    def refused() -> int:
        state = graph.state("solver: Inputs", "")
        return int({v.key: v.value for v in state.values}["refused"])

    graph.wait(lambda: refused() >= 3)
    # A second later too.
    assert refused() == 3

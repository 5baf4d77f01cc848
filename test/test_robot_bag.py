# SPDX-License-Identifier: Apache-2.0
"""A robot's own bag gives the same fixes by the command line without ROS, and by the nodes."""

import math
from pathlib import Path

import numpy as np
import pytest
from std_srvs.srv import Trigger

from starpos.recording.drivers import Drivers
from starpos.session.replay import Replay
from starpos.session.settings import Settings
from starpos_testing.skies import robots
from starpos_testing.skies.bags import Quiet

PARAMETERS = Path(__file__).parents[1] / "src" / "starpos_bringup" / "config" / "existing_robot.yaml"
TOPICS = ("-r", "camera/image_raw:=/cam0/image_raw", "-r", "camera/camera_info:=/cam0/camera_info")


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    folder = tmp_path_factory.mktemp("bag") / "bag"
    robots.write(folder)
    return folder


def told(latitude_deg, longitude_deg, covariance):
    return latitude_deg, longitude_deg, *np.ravel(covariance)[[0, 1, -2, -1]].tolist()


@pytest.fixture(scope="module")
def expected(bag):
    """The fixes of the bag without ROS, by stamp."""
    replay = Replay(Settings.of(PARAMETERS, ()), Quiet(), Drivers.of(PARAMETERS, ()))
    fixes = {}
    for made in replay.play(bag):
        if (ground := getattr(made, "ground", None)) and hasattr(made, "solution"):
            place = math.degrees(ground.latitude), math.degrees(ground.longitude)
            fixes[made.stamp.sec, made.stamp.nanosec] = told(*place, ground.covariance[:2, :2])
    assert len(fixes) == robots.FRAMES
    return fixes


@pytest.fixture(scope="module")
def nodes(graph, tmp_path_factory):
    """The three nodes as on the robot, in simulated time."""
    folder = tmp_path_factory.mktemp("nodes")
    arguments = ("--ros-args", "--params-file", str(PARAMETERS), *TOPICS)
    for package, name in (
        ("starpos_camera", "detector"),
        ("starpos_inclinometer", "inclinometer"),
        ("starpos_solver", "solver"),
    ):
        graph.start(folder / name, package, name, "use_sim_time:=true", arguments=arguments)


def play(graph, run, bag, rate, *more):
    replay = run(
        "starpos_bringup", "replay", arguments=(str(bag), "--inputs", "images", "--rate", rate, *more)
    )
    assert replay.wait() == 0, replay.output
    assert f"{robots.FRAMES} frames, {robots.FRAMES} answers, {robots.FRAMES} fixes" in replay.output
    return replay.output


def check(graph, expected):
    graph.wait(lambda: len(graph.fixes) == len(expected), "for all fixes")
    got = {
        stamp: told(m.latitude, m.longitude, np.reshape(m.position_covariance, (3, 3))[:2, :2])
        for stamp, (m,) in graph.fixes.items()
    }
    assert got == expected
    graph.fixes.clear()
    assert graph.call(Trigger, "solver/reset", Trigger.Request()).success


@pytest.mark.usefixtures("nodes")
def test_the_nodes_and_the_command_line_agree_to_the_last_bit(graph, run, bag, expected):
    """The first replay waits for all three nodes; the IMU's topic is found by its type."""
    output = play(graph, run, bag, "0")
    assert "/cam0/image_raw" in output
    check(graph, expected)
    play(graph, run, bag, "1")
    check(graph, expected)

# SPDX-License-Identifier: Apache-2.0
"""A bag gives the same answers each time: by our player, by another's, and by the command line without ROS."""

import math
import signal
import time
from pathlib import Path

import pytest
from rclpy.qos import QoSProfile
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import NavSatFix
from std_srvs.srv import Trigger

from starpos.session.driver import Answered
from starpos.session.replay import Replay
from starpos.session.settings import Settings
from starpos_bringup.bag import Bag
from starpos_common.messages import attitude_to_message, unix_to_stamp
from starpos_interfaces.msg import Attitude, Tilt
from starpos_testing.graph.graph import stamp_of
from starpos_testing.skies.bags import Quiet, part_of

NIGHT = Path(__file__).parent / "data" / "night"
KNOWN = ("refraction.pressure:=66000.0", "refraction.temperature:=-4.0", "refraction.humidity:=0.4",
         "misalignment:=[0.31, -0.22, 0.53]", "misalignment_stddev:=0.1",
         "inclinometer.model:=sca100t_calibrated")  # fmt: skip
# Between ticks, as `ros2 bag play --clock` does.
CLOCK_S = 0.025


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    return part_of(NIGHT, tmp_path_factory.mktemp("bag") / "bag", 0.0, 10.0)


@pytest.fixture(scope="module")
def expected(bag):
    """(fixes, averages, attitudes) of the bag without ROS, by stamp; angles in deg, attitudes as messages."""
    fixes, averages, attitudes = {}, {}, {}
    settings = Settings.of(None, KNOWN)
    for made in Replay(settings, Quiet()).play(bag):
        assert isinstance(made, Answered)
        key = made.stamp.sec, made.stamp.nanosec
        attitudes[key] = attitude_to_message(made.attitude)
        for kept, ground in (fixes, made.ground), (averages, made.average.on_ground(settings.vertical)):
            kept[key] = (
                math.degrees(ground.latitude),
                math.degrees(ground.longitude),
                *ground.covariance[:2, :2].ravel().tolist(),
            )
    assert len(fixes) == len(averages) == len(attitudes) == 2
    return fixes, averages, attitudes


def told(message: NavSatFix):
    c = message.position_covariance
    return message.latitude, message.longitude, c[0], c[1], c[3], c[4]


@pytest.fixture(scope="module")
def solver(graph, tmp_path_factory):
    """A solver whose time is simulated."""
    log = tmp_path_factory.mktemp("solver") / "log"
    process = graph.start(log, "starpos_solver", "solver", "use_sim_time:=true", *KNOWN)
    graph.wait_for_solver()
    return process


@pytest.fixture(scope="module")
def averages(graph, solver):
    return graph.hear(NavSatFix, "fix_averaged")


@pytest.fixture(scope="module")
def attitudes(graph):
    return graph.hear(Attitude, "attitude")


@pytest.fixture
def nothing_known(graph, averages, attitudes):
    assert graph.call(Trigger, "solver/reset", Trigger.Request()).success
    graph.solutions.clear(), graph.fixes.clear(), averages.clear(), attitudes.clear()


def check(graph, averages, attitudes, expected):
    fixes, means, turns = expected
    kept = (graph.fixes, fixes), (averages, means), (attitudes, turns)
    graph.wait(lambda: all(len(heard) == len(wanted) for heard, wanted in kept), "for all fixes")
    assert {stamp_of(m): m for m in attitudes} == turns
    assert {stamp: told(messages[0]) for stamp, messages in graph.fixes.items()} == fixes
    stamps = [(m.header.stamp.sec, m.header.stamp.nanosec) for m in averages]
    assert dict(zip(stamps, map(told, averages), strict=True)) == means


@pytest.mark.usefixtures("nothing_known")
@pytest.mark.parametrize("rate", ["0", "10"])
def test_the_player_and_the_command_line_agree_to_the_last_bit(
    graph, run, bag, averages, attitudes, expected, rate
):
    replay = run("starpos_bringup", "replay", arguments=(str(bag), "--rate", rate, "--inputs", "stars"))
    assert replay.wait() == 0, replay.output
    assert "2 frames, 2 answers, 2 fixes" in replay.output and "incompatible QoS" not in replay.output
    check(graph, averages, attitudes, expected)


@pytest.mark.usefixtures("nothing_known")
def test_a_bag_gives_all_its_fixes_after_a_player_that_was_killed(
    graph, run, solver, bag, averages, attitudes, expected
):
    # so slow that it never comes to the second frame
    killed = run("starpos_bringup", "replay", arguments=(str(bag), "--rate", "0.2", "--inputs", "stars"))
    graph.wait(lambda: graph.fixes, "for a fix")
    killed.signal(signal.SIGKILL)
    killed.wait()
    replay = run("starpos_bringup", "replay", arguments=(str(bag), "--rate", "0", "--inputs", "stars"))
    assert replay.wait() == 0, replay.output
    assert "2 frames, 2 answers, 2 fixes" in replay.output
    assert "inclinometers publish" not in solver.output, solver.output
    # what comes later would be counted in the next test
    last = max(expected[0])
    graph.wait(lambda: last in graph.fixes and last in map(stamp_of, attitudes), "for the last attitude")
    graph.wait(lambda: last in map(stamp_of, averages), "for the last average")


def play_as_others_do(graph, bag, rate):
    """Publish a bag and /clock without asking, as `ros2 bag play --clock`."""
    clock = graph.node.create_publisher(Clock, "/clock", QoSProfile(depth=1))
    with Bag(bag) as opened:
        topics = opened.topics(None, print)
        publishers = {
            t.name: graph.node.create_publisher(t.kind, t.name, QoSProfile(depth=1000))
            for t in topics.values()
        }
        every = (*publishers.values(), clock)
        graph.wait(lambda: all(p.get_subscription_count() for p in every), "for who listens")
        begin_s, first_ns = time.monotonic(), None
        for topic, log_ns, data in opened.played(topics):
            first_ns = log_ns if first_ns is None else first_ns
            due_s = begin_s + (log_ns - first_ns) * 1e-9 / rate
            while time.monotonic() < due_s:
                graph.comes(lambda: False, min(CLOCK_S, max(due_s - time.monotonic(), 0.0)))
                passed_s = (time.monotonic() - begin_s) * rate
                clock.publish(Clock(clock=unix_to_stamp(first_ns * 1e-9 + passed_s)))
            publishers[topic.name].publish(data)
    # theirs, too, stay until all has arrived
    graph.wait(lambda: len(graph.fixes) == 2, "for the fixes")
    for publisher in every:
        graph.node.destroy_publisher(publisher)


@pytest.mark.usefixtures("nothing_known")
def test_a_player_who_asks_nobody_gives_the_same_where_nothing_is_dropped(
    graph, bag, averages, attitudes, expected
):
    play_as_others_do(graph, bag, 10.0)
    check(graph, averages, attitudes, expected)


@pytest.mark.usefixtures("solver")
def test_what_such_a_player_loses_is_named(graph, run):
    graph.node.destroy_publisher(graph.tilt)
    graph.tilt = graph._publisher(Tilt, "tilt", 1000)
    solver = run(
        "starpos_solver", "solver", "use_sim_time:=true", "qos_overrides./tilt.subscription.depth:=1"
    )
    graph.wait(lambda: graph.tilt.get_subscription_count() == 2)

    def lost():
        for _ in range(200):
            graph.tilt.publish(Tilt())
        return graph.comes(lambda: "dropped on the way" in solver.output, 0.2)

    graph.wait(lost, "for the warning")
    assert "messages were dropped on the way: play it slower" in solver.output

# SPDX-License-Identifier: Apache-2.0
"""Bags through the running graph, and the replay's messages on invalid ones."""

import json
import os
import signal
import sqlite3
from pathlib import Path

import make_bag
import numpy as np
import pytest
import yaml
from rclpy.qos import DurabilityPolicy, QoSProfile
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from rosgraph_msgs.msg import Clock
from std_msgs.msg import String
from std_srvs.srv import Trigger

from starpos_bringup import replay
from starpos_bringup.bag import offered_qos
from starpos_interfaces.msg import Solution, StarArray
from starpos_testing.graph.graph import stamp_of
from starpos_testing.graph.shots import photograph
from starpos_testing.patience import WAIT_S
from starpos_testing.skies.bags import knowing

NIGHT = Path(__file__).parent / "data" / "night"
LATCHED = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
S = 10**9


@pytest.fixture(scope="module")
def truth():
    return json.loads(NIGHT.with_suffix(".json").read_text())


# Before there is an instrument.
def test_a_replay_that_nobody_hears_says_so(graph, run):
    player = run("starpos_bringup", "replay", arguments=(str(NIGHT), "--rate", "0", "--wait", "0.2"))
    assert player.wait() == 1
    assert "13 frames, 0 answers, 0 fixes" in player.output, player.output
    assert "no node subscribes to" in player.output and "/stars" in player.output, player.output


def test_a_replay_that_only_strangers_hear_says_so(graph, run):
    heard = [
        graph.node.create_subscription(kind, name, lambda message: None, 10)
        for kind, name in ((StarArray, "/stars"), (Clock, "/clock"))
    ]
    player = run(
        "starpos_bringup",
        "replay",
        arguments=(str(NIGHT), "--topics", "/stars", "--rate", "0", "--wait", str(WAIT_S)),
    )
    assert player.wait() == 1, player.output
    assert "10 frames, 0 answers, 0 fixes" in player.output
    assert "no solver publishes solutions" in player.output
    for subscription in heard:
        graph.node.destroy_subscription(subscription)


@pytest.fixture(scope="module")
def instrument(graph, truth, tmp_path_factory):
    """Detector and solver that know what the bag's instrument is."""
    folder = tmp_path_factory.mktemp("instrument")
    graph.start(folder / "solver.log", "starpos_solver", "solver", *knowing(truth))
    graph.wait_for_solver()
    graph.start(folder / "detector.log", "starpos_camera", "detector", "use_sim_time:=true")
    graph.wait_for_detector(photograph)


def play(graph, run, truth):
    """The bag as fast as it is taken: (solution, imu) of each frame, by stamp."""
    assert graph.call(Trigger, "solver/reset", Trigger.Request()).success
    graph.solutions.clear(), graph.imus.clear()
    player = run("starpos_bringup", "replay", arguments=(str(NIGHT), "--rate", "0"))
    count = len(truth["frames"])
    assert player.wait() == 0, player.output
    assert f"{count} frames, {count} answers, {count} fixes" in player.output, player.output
    assert "of the bag, another node publishes /" in player.output, player.output
    graph.wait(lambda: len(graph.solutions) == len(graph.imus) == count, f"for all; {player.output}")
    return {s: (graph.solutions[s][0], graph.imus[s][0]) for s in sorted(graph.solutions)}


def test_the_bag_gives_its_place_twice_the_same(graph, run, instrument, truth):
    first = play(graph, run, truth)
    for (stamp, (solution, imu)), frame in zip(first.items(), truth["frames"], strict=True):
        assert stamp[0] + stamp[1] * 1e-9 == frame["mid_unix_s"] and stamp_of(imu) == stamp
        assert solution.status == Solution.OK, solution.status_text
        assert solution.tilt_samples == 5
        off = np.array(
            [
                np.radians(solution.longitude - truth["longitude_deg"])
                * np.cos(np.radians(truth["latitude_deg"])),
                np.radians(solution.latitude - truth["latitude_deg"]),
            ]
        )
        turned = (solution.heading - frame["heading_deg"] + 180) % 360 - 180
        error = np.array([*off * 6.38e6, turned])
        covariance = np.reshape(solution.covariance, (3, 3))
        assert (np.abs(error) < 4 * np.sqrt(np.diag(covariance))).all(), (error, np.sqrt(np.diag(covariance)))
        stars = frame["kind"] == "stars"
        assert np.degrees(np.abs(off).max()) * 3600 < (1.5 if stars else 5.0)
        assert abs(turned) * 3600 < (5.0 if stars else 20.0)
    second = play(graph, run, truth)
    assert list(first) == list(second)
    for stamp, (solution, imu) in first.items():
        other, other_imu = second[stamp]
        # Repr: NaN equals NaN.
        assert repr(solution) == repr(other) and imu == other_imu


def test_the_kept_script_makes_this_bag(tmp_path, truth):
    make_bag.make(tmp_path / "night")
    # of headings the last digits may be others, as roundings fall
    frames = [f | {"heading_deg": pytest.approx(f["heading_deg"], abs=1e-9)} for f in truth["frames"]]
    assert json.loads((tmp_path / "night.json").read_text()) == truth | {"frames": frames}
    made, kept = (
        yaml.safe_load((folder / "metadata.yaml").read_text()) for folder in (tmp_path / "night", NIGHT)
    )
    # the kept one is of the first release: its Tilt, and so Solution, had no third axis, the others no shutter
    for about in (made, kept):
        for topic in about["rosbag2_bagfile_information"]["topics_with_message_count"]:
            kind = topic["topic_metadata"]["type"].removeprefix("starpos_interfaces/msg/")
            if kind in ("Tilt", "Solution", "Capture", "StarArray"):
                del topic["topic_metadata"]["type_description_hash"]
    assert made == kept


def write_bag(folder, messages, plugin=StoragePlugin.MCAP):
    """A bag of (log ns, topic, type, bytes); every topic latched. Unknown types get a definition."""
    store = get_typestore(Stores.ROS2_JAZZY)
    latched = offered_qos(latched=True)
    with Writer(folder, version=9, storage_plugin=plugin) as writer:
        connections = {}
        for log_ns, topic, kind, data in messages:
            if topic not in connections:
                given = (
                    {"typestore": store}
                    if kind in store.types
                    else {"msgdef": "int8 a\n", "rihs01": "RIHS01_0"}
                )
                connections[topic] = writer.add_connection(
                    topic, kind, offered_qos_profiles=[latched], **given
                )
            writer.write(connections[topic], log_ns, data)
    return folder


def text(words: str) -> bytes:
    store = get_typestore(Stores.ROS2_JAZZY)
    return bytes(store.serialize_cdr(store.types["std_msgs/msg/String"](data=words), "std_msgs/msg/String"))


STRING = "std_msgs/msg/String"


@pytest.mark.parametrize("plugin", [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
def test_latched_topics_reach_latecomers_and_a_signal_ends_it(graph, run, tmp_path, plugin):
    messages = [(S, "/words", STRING, text("early")), (1000 * S, "/words", STRING, text("late"))]
    bag = write_bag(tmp_path / "bag", messages, plugin)
    player = run("starpos_bringup", "replay", arguments=(str(bag), "--wait", "0"))
    graph.wait(lambda: graph.node.count_publishers("/words"))
    clock = graph.hear(Clock, "/clock")
    # It is past its first message.
    graph.wait(lambda: len(clock) > 10)
    times = [m.clock.sec * S + m.clock.nanosec for m in clock]
    assert times == sorted(set(times)) and S <= times[0] < times[-1] < 1000 * S
    heard = graph.hear(String, "/words", LATCHED)
    graph.wait(lambda: heard)
    assert heard[0].data == "early"
    player.signal(signal.SIGINT, signal.SIGINT)
    assert player.wait() == 0 and "Traceback" not in player.output, player.output


def test_a_single_file_and_chosen_topics(graph, run, tmp_path):
    messages = [(S + k, f"/words{k % 2}", STRING, text(str(k))) for k in range(8)]
    bag = write_bag(tmp_path / "bag", messages)
    heard = [graph.hear(String, f"/words{k}", LATCHED) for k in range(2)]
    player = run(
        "starpos_bringup", "replay", arguments=(str(bag / "bag.mcap"), "--topics", "/words1", "--rate", "0")
    )
    assert player.wait() == 0, player.output
    graph.wait(lambda: len(heard[1]) == 4)
    assert [m.data for m in heard[1]] == ["1", "3", "5", "7"] and not heard[0]


def test_what_a_bag_may_not_bring(graph, run, tmp_path):
    """Types that are not installed, invalid names, bytes that are no message: left out, the rest is played."""
    messages = [
        (1 * S, "/a", "os/msg/Path", b"\0\1\0\0\0"),
        (2 * S, "/b", "os.path/msg/../X", b"\0\1\0\0\0"),
        (3 * S, "not a name", STRING, text("x")),
        (4 * S, "/clock", "rosgraph_msgs/msg/Clock", b"\0\1\0\0" + bytes(8)),
        (5 * S, "/words", STRING, b"\0\1\0\0\xff\xff\xff\x7fabc"),
        (6 * S, "/words", STRING, text("good")),
        (7 * S, "/words", STRING, b""),
    ]
    bag = write_bag(tmp_path / "bag", messages)
    heard, clock = graph.hear(String, "/words", LATCHED), graph.hear(Clock, "/clock")
    player = run("starpos_bringup", "replay", arguments=(str(bag), "--rate", "0"))
    assert player.wait() == 0, player.output
    graph.wait(lambda: heard)
    assert [m.data for m in heard] == ["good"]
    assert all(m.clock.sec for m in clock)
    for words in ("'os/msg/Path' is not installed", "'not a name' is left out", "2 broken ones left out"):
        assert words in player.output, player.output


def changed(tmp_path, change) -> Path:
    folder = tmp_path / "bag"
    folder.mkdir()
    for file in NIGHT.iterdir():
        (folder / file.name).write_bytes(change(file.name, file.read_bytes()))
    return folder


def no_folder(tmp_path):
    return tmp_path / "none", "there is no such bag"


def empty_folder(tmp_path):
    return tmp_path, "no bag"


def a_picture(tmp_path):
    (tmp_path / "x.png").write_bytes(b"\x89PNG")
    return tmp_path / "x.png", "not a readable bag"


def truncated(tmp_path):
    return changed(tmp_path, lambda name, data: data[:5000] if name.endswith("mcap") else data), "was cut off"


def garbage(tmp_path):
    return changed(
        tmp_path, lambda name, data: b"\xff" * 100 if name.endswith("mcap") else data
    ), "not a readable"


def bad_metadata(tmp_path):
    return changed(
        tmp_path, lambda name, data: data if name.endswith("mcap") else b"a: [1"
    ), "not a readable bag"


def another_version_of_a_type(tmp_path):
    def change(name, data):
        return data if name.endswith("mcap") else data.replace(b"RIHS01_", b"RIHS01_0000")

    return changed(tmp_path, change), "nothing in it to play"


def a_broken_database(tmp_path):
    with sqlite3.connect(tmp_path / "x.db3") as database:
        database.execute("create table topics (id int)")
    return tmp_path / "x.db3", "not a readable bag"


@pytest.mark.parametrize(
    "make",
    [no_folder, empty_folder, a_picture, truncated, garbage, bad_metadata, another_version_of_a_type, a_broken_database],
)  # fmt: skip
def test_what_is_no_bag_is_refused_in_a_sentence(capsys, tmp_path, make):
    bag, words = make(tmp_path)
    said = refused(capsys, bag)
    assert words in said and str(tmp_path) in said
    assert all(line.startswith("replay:") for line in said.splitlines())


def refused(capsys, *arguments) -> str:
    """The sentence with which the player refuses arguments, in this process."""
    try:
        status = replay.main([str(a) for a in arguments], [])
    except SystemExit as end:
        status = end.code
    assert status == replay.REFUSED
    return capsys.readouterr().err


def test_only_the_inputs_are_played_whatever_their_namespace_and_not_what_was_made_of_them(
    graph, run, tmp_path
):
    names = ("/rover/stars", "/rover/tilt", "/rover/fix", "/rover/camera/image_raw", "/stars_of_another_kind")
    messages = [(k * S, name, STRING, text(name)) for k, name in enumerate(names, 1)]
    bag, heard = write_bag(tmp_path / "bag", messages), {n: graph.hear(String, n, LATCHED) for n in names}
    for inputs, played in (("stars", names[:2]), ("images", (names[1], names[3]))):
        for said in heard.values():
            said.clear()
        player = run(
            "starpos_bringup",
            "replay",
            arguments=(str(bag), "--rate", "0", "--inputs", inputs, "--wait", "10"),
        )
        assert player.wait() == 0, player.output
        graph.wait(lambda names=played: all(heard[name] for name in names))
        assert {name for name, said in heard.items() if said} == set(played)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ((NIGHT, "--rate", "-1"), "-1 must lie between 0 and"),
        ((NIGHT, "--rate", "nan"), "nan must lie between 0 and"),
        ((NIGHT, "--rate", "abc"), "invalid float value: 'abc'"),
        ((NIGHT, "--topics", "/nothing"), "no topic /nothing"),
        ((), "BAG"),
        ((NIGHT, "--inputs", "moon"), "--inputs"),
        ((NIGHT, "--inputs", "stars", "--topics", "/stars"), "not allowed with"),
        ((NIGHT, "--ros-args", "-p"), "replay: "),
    ],
)
def test_bad_calls(capsys, arguments, said):
    assert said in refused(capsys, *arguments)


def test_without_rosbags(run, tmp_path, monkeypatch):
    (tmp_path / "rosbags.py").write_text("raise ImportError\n")
    monkeypatch.setenv("PYTHONPATH", f"{tmp_path}{os.pathsep}{os.environ.get('PYTHONPATH', '')}")
    player = run("starpos_bringup", "replay", arguments=(str(NIGHT),))
    assert player.wait() == 2
    assert player.output == "replay: rosbags, which reads bags, is not installed: pip install rosbags\n"

# SPDX-License-Identifier: Apache-2.0
"""A night recorded as it comes, and what is left of it when the disk is full."""

import resource
import signal
import sys

import numpy as np
import pytest
from rclpy.duration import Duration
from rclpy.qos import ReliabilityPolicy
from rclpy.serialization import deserialize_message, serialize_message
from rosbags.rosbag2 import Reader

from starpos_bringup.record import REFUSED, record
from starpos_interfaces.msg import Solution
from starpos_testing.graph.shots import SOLVER, photograph, shoot
from starpos_testing.prepared import interpreted

# Those that this file's messages go to.
TOPICS = ("stars", "tilt", "camera/capture", "camera/image_raw", "solver/solution", "fix")


@pytest.fixture
def recorded(graph, run, tmp_path):
    """recorded(*options): start to record; stop(): the bag's messages by topic."""

    def recorded(*options, start=None):
        process = run("starpos_bringup", "record", arguments=(str(tmp_path / "bag"), *options), start=start)
        graph.wait(lambda: "recording" in process.output)
        graph.wait(
            lambda: graph.stars.get_subscription_count() == 2 and graph.tilt.get_subscription_count() == 2
        )
        return process

    return recorded


def messages_of(folder) -> dict[str, list[bytes]]:
    by_topic = {}
    with Reader(folder) as reader:
        for connection, _, data in reader.messages():
            by_topic.setdefault(connection.topic, []).append(bytes(data))
    return by_topic


def fields(message) -> dict:
    """A message's content: NaN equals NaN in it."""
    return {name: getattr(message, name) for name in message.get_fields_and_field_types()}


def counts_of(graph, report=-1) -> dict[str, int]:
    """Messages by topic that the recorder says it has."""
    said = {v.key: v.value for v in graph.diagnostics["record: Bag"][report][1].values}
    return {topic: int(said[topic]) for topic in TOPICS}


def settled_counts_of(graph) -> dict[str, int]:
    """Messages by topic that the recorder has, when nothing that was published is still under way to it."""
    for publisher in (graph.stars, graph.tilt, graph.capture, graph.image):
        graph.wait(lambda p=publisher: p.wait_for_all_acked(Duration()))
    # Its queues are empty where it took nothing between two reports. The first may have been sent before.
    graph.diagnostics["record: Bag"].clear()
    reports = graph.diagnostics["record: Bag"]
    graph.wait(lambda: len(reports) > 2 and counts_of(graph, -2) == counts_of(graph))
    return counts_of(graph)


def test_what_was_published_is_in_the_bag_bit_for_bit_and_gives_the_same_fixes(
    graph, recorded, run, tmp_path
):
    run("starpos_solver", "solver", "use_sim_time:=true", *SOLVER)
    graph.wait_for_solver()
    process = recorded("--images")
    graph.state("record: Bag", "recording")
    _, image, capture = photograph()

    def recorder_knows_all():
        """A publisher may know the recorder before the recorder knows it: until then messages are lost."""
        graph.answer(shoot())
        graph.capture.publish(capture)
        graph.image.publish(image)
        return graph.comes(lambda: all(counts_of(graph).values()), 2.0)

    graph.wait(recorder_knows_all)
    begun = settled_counts_of(graph)
    shots = [shoot() for _ in range(3)]
    answers = [graph.answer(shot)[0] for shot in shots]
    more = {"stars": 3, "tilt": 3 * len(shots[0].tilts), "solver/solution": 3, "fix": 3}
    graph.wait(lambda: all(counts_of(graph)[name] >= begun[name] + n for name, n in more.items()))

    process.signal(signal.SIGINT)
    assert process.wait() == 0, process.output
    kept = messages_of(tmp_path / "bag")
    for topic, sent in {
        "/stars": [s.stars for s in shots],
        "/tilt": [t for s in shots for t in s.tilts],
        "/camera/image_raw": [image] * len(kept["/camera/image_raw"]),
        "/camera/capture": [capture] * len(kept["/camera/capture"]),
    }.items():
        # not the bytes themselves: rmw leaves whatever was in memory between the fields
        kind, wanted = type(sent[0]), [serialize_message(m) for m in sent]
        got, wanted = (
            [fields(deserialize_message(data, kind)) for data in side]
            for side in (kept[topic][-len(sent) :], wanted)
        )
        np.testing.assert_equal(got, wanted, topic)
    assert len(kept["/solver/solution"]) == len(kept["/fix"]) and kept["/diagnostics"]
    size = sum(f.stat().st_size for f in (tmp_path / "bag").iterdir())
    # Noise is what does not compress.
    assert size < 0.7 * sum(len(m) for sent in kept.values() for m in sent)

    graph.solutions.clear()
    again = run(
        "starpos_bringup", "replay", arguments=(str(tmp_path / "bag"), "--rate", "0", "--inputs", "stars")
    )
    assert again.wait() == 0, again.output
    for shot, before in zip(shots, answers, strict=True):
        after, _, _ = graph.result(shot.stamp)
        assert after.status == Solution.OK
        np.testing.assert_array_equal(
            [after.latitude, after.longitude, after.heading, *after.covariance],
            [before.latitude, before.longitude, before.heading, *before.covariance],
        )


def test_a_full_disk_ends_the_recording_with_a_sentence(graph, solver, recorded):
    # A forked one that can write nothing any more fails as it ends, in the C library.
    process = recorded(start=interpreted)
    # As a disk with no more room.
    resource.prlimit(process.process.pid, resource.RLIMIT_FSIZE, (4096, 4096))
    shot = shoot()
    while process.process.poll() is None:
        for _ in range(10):
            graph.send(shot)
        graph.comes(lambda: process.process.poll() is not None, 0.1)
    assert process.wait() == 1
    assert "cannot be written" in process.output and "Traceback" not in process.output


def test_the_recorder_hears_a_publisher_of_best_effort_where_it_is_told(graph, run, tmp_path):
    override = "qos_overrides./tilt.subscription.reliability:=best_effort"
    process = run("starpos_bringup", "record", override, arguments=(str(tmp_path / "bag"),))
    graph.wait(lambda: "recording" in process.output)

    def reliability(topic):
        ears = graph.node.get_subscriptions_info_by_topic(topic)
        return {ear.qos_profile.reliability for ear in ears if ear.node_name == "record"}

    graph.wait(lambda: reliability("/tilt") == {ReliabilityPolicy.BEST_EFFORT})
    graph.wait(lambda: reliability("/stars") == {ReliabilityPolicy.RELIABLE})


def test_nothing_is_overwritten_and_nothing_made_in_a_place_that_is_none(tmp_path, monkeypatch, capsys):
    (tmp_path / "bag").mkdir()
    (tmp_path / "file").touch()
    for place, words in (
        (tmp_path / "bag", "something of that name"),
        (tmp_path / "file" / "x", "no bag can be made"),
    ):
        monkeypatch.setattr(sys, "argv", ["record", str(place)])
        assert record() == REFUSED and words in capsys.readouterr().err

# SPDX-License-Identifier: Apache-2.0
"""A node's part in a replay: nothing is taken before its turn, whatever comes first."""

import time
from types import SimpleNamespace

import pytest
import rclpy
from builtin_interfaces.msg import Time
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import Header

from starpos_common import replayed
from starpos_common.replayed import ENDED_S, SILENT_S, Replayed
from starpos_common.topics import Dropped
from starpos_interfaces.msg import Played, Tilt
from starpos_testing.nodes import take_domain


@pytest.fixture
def node():
    take_domain()
    context = rclpy.Context()
    rclpy.init(context=context)
    node = rclpy.create_node("mine", context=context)
    yield node
    node.destroy_node()
    rclpy.shutdown(context=context)


class Taking:
    """A node that takes tilts and works on them while a test wants it to."""

    def __init__(self, node):
        self.took, self.busy, self.begun, self.ended = [], False, 0, 0
        made = node.create_publisher(Tilt, "made", 1)
        self.replayed = Replayed(
            node, {"tilt": self._take}, [made], lambda: self.busy, self._begin, self._end
        )

    def _take(self, message, info):
        self.took.append((message.header.stamp.sec, self.replayed.unix_s))

    def _begin(self):
        self.begun += 1

    def _end(self):
        self.ended += 1

    def tilt(self, second) -> bool:
        return self.replayed.holds("tilt", Tilt(header=Header(stamp=Time(sec=second))), {})

    def turn(self, index, second=0, kind=Played.MESSAGE, topic="/tilt", replay=7):
        stamp = Time(sec=second)
        topic = topic if kind == Played.MESSAGE else ""
        self.replayed._on_played(
            Played(
                replay=replay, index=index, kind=kind, time=Time(sec=second + 100), topic=topic, stamp=stamp
            )
        )


@pytest.fixture
def taking(node):
    return Taking(node)


def test_without_a_replay_nothing_is_held(taking):
    assert not taking.tilt(1) and not taking.replayed.playing


def test_messages_are_taken_in_the_order_and_at_the_time_they_were_played(taking):
    taking.turn(0, kind=Played.BEGIN)
    assert taking.tilt(2) and taking.tilt(1) and taking.took == []
    taking.turn(1, 1)
    taking.turn(2, 9, topic="/another")
    taking.turn(3, 2)
    taking.turn(4, 3)
    assert taking.took == [(1, 101.0), (2, 102.0)]
    assert taking.tilt(3) and taking.took[-1] == (3, 103.0)
    assert taking.begun == 1 and taking.ended == 0
    taking.turn(5, 3, kind=Played.END)
    assert taking.ended == 1 and not taking.replayed.playing


def test_a_beginning_that_is_said_again_takes_nothing_back(taking):
    taking.turn(0, kind=Played.BEGIN)
    taking.tilt(1), taking.turn(1, 1)
    taking.tilt(2)
    taking.turn(0, kind=Played.BEGIN)
    taking.turn(2, 2)
    assert taking.took == [(1, 101.0), (2, 102.0)] and taking.begun == 1


def test_the_next_waits_while_the_node_works(taking):
    taking.turn(0, kind=Played.BEGIN)
    taking.tilt(1), taking.turn(1, 1)
    taking.busy = True
    taking.tilt(2), taking.turn(2, 2)
    assert taking.took == [(1, 101.0)]
    taking.busy = False
    taking.replayed.go_on()
    assert taking.took == [(1, 101.0), (2, 102.0)]


def test_another_replay_leaves_nothing_of_the_last(taking):
    taking.turn(0, kind=Played.BEGIN)
    taking.tilt(1)
    taking.turn(0, kind=Played.BEGIN, replay=8)
    taking.turn(1, 1, replay=8)
    taking.turn(1, 1)
    assert taking.took == []
    taking.tilt(1)
    assert len(taking.took) == 1 and taking.begun == 2


def test_a_number_that_is_said_again_is_no_message(taking):
    taking.turn(0, kind=Played.BEGIN)
    taking.tilt(1), taking.turn(1, 1)
    taking.tilt(1), taking.turn(1, 1)
    assert taking.took == [(1, 101.0)]


@pytest.fixture
def warned(node, monkeypatch):
    """What the node warns of."""
    said = []
    monkeypatch.setattr(node, "get_logger", lambda: SimpleNamespace(warning=said.append))
    return said


@pytest.fixture
def passes(taking, monkeypatch):
    """Has some seconds pass while the node beats; or, with still, while it stands still."""
    now_s = [time.monotonic()]
    monkeypatch.setattr(replayed, "time", SimpleNamespace(monotonic=lambda: now_s[0]))

    def passes(seconds, still=False):
        step_s = seconds if still else 0.1
        for _ in range(round(seconds / step_s)):
            now_s[0] += step_s
            taking.replayed._beat()

    return passes


@pytest.mark.parametrize(("shown", "after_s"), [(False, ENDED_S), (True, SILENT_S)])
def test_a_player_that_was_killed_holds_the_node_up_for_seconds_and_it_says_what_is_left_out(
    node, taking, warned, passes, shown, after_s
):
    # as the graph shows a killed one
    dead = [node.create_publisher(Played, replayed.PLAYED, 1) for _ in range(shown)]
    taking.turn(0, kind=Played.BEGIN)
    taking.turn(1, 9), taking.tilt(1), taking.tilt(2)
    passes(after_s - 1)
    assert taking.replayed.playing
    # its last number, once more
    taking.turn(1, 0, topic="")
    passes(after_s - 1)
    assert taking.replayed.playing and warned == []
    passes(2)
    assert not taking.tilt(3) and taking.took == []
    assert warned == ["the player ended in the middle, and 2 messages are left out: play it again"]
    passes(SILENT_S)
    assert len(warned) == 1
    for publisher in dead:
        node.destroy_publisher(publisher)


def test_a_node_that_stood_still_waits_for_what_was_said_meanwhile(taking, passes):
    taking.turn(0, kind=Played.BEGIN)
    passes(2 * SILENT_S, still=True)
    assert taking.replayed.playing


def test_messages_of_others_than_the_player_are_named_at_the_end(taking, warned):
    taking.turn(0, kind=Played.BEGIN)
    taking.tilt(1), taking.tilt(5), taking.turn(1, 1)
    taking.turn(2, kind=Played.END)
    [said] = warned
    assert said.startswith("1 messages on /tilt are left out") and "start it with use_sim_time" in said


@pytest.fixture
def published(node):
    """Has the node publish tilts with a QoS, as another does in the graph."""
    made = []

    def published(**qos):
        made.append(node.create_publisher(Tilt, "tilt", QoSProfile(depth=1, **qos)))

    yield published
    for publisher in made:
        node.destroy_publisher(publisher)


def numbers_of(node, *numbers):
    dropped = Dropped(node, "play it slower")
    for number in numbers:
        dropped.came("tilt", {"publication_sequence_number": number})
    return dropped


def test_messages_that_never_came_are_counted_by_the_numbers_of_one_publisher(node, warned, published):
    published()
    dropped = numbers_of(node, 1, 2, 5, 5, 7)
    dropped.came("stars", {"publication_sequence_number": None})
    assert dropped.counts == {"tilt": 3}
    assert warned == ["/tilt: 2 messages were dropped on the way: play it slower"]


def test_messages_from_before_the_node_listened_are_counted_and_named(node, warned, published):
    published()
    assert numbers_of(node, 8, 9, 12).counts == {"tilt": 9}
    # the second is another publisher
    assert numbers_of(node, 1, 2, 4, 2, 3).counts == {"tilt": 2}
    early = "/tilt: {} messages came before this node listened: start it first"
    assert [w for w in warned if "listened" in w] == [early.format(7), early.format(1)]
    assert sum("dropped on the way" in w for w in warned) == 2


def test_what_was_latched_before_the_node_listened_is_no_loss(node, warned, published):
    published(durability=DurabilityPolicy.TRANSIENT_LOCAL)
    assert numbers_of(node, 8, 9).counts == {} and warned == []


def test_messages_from_before_are_told_once_the_graph_shows_their_publisher(node, warned, published):
    dropped = numbers_of(node, 8)
    assert warned == []
    published()
    dropped.came("tilt", {"publication_sequence_number": 9})
    assert dropped.counts == {"tilt": 7} and len(warned) == 1


def test_of_several_publishers_nothing_is_told(node, warned, published):
    published(), published()
    assert numbers_of(node, 8, 1, 9, 2).counts == {} and warned == []

# SPDX-License-Identifier: Apache-2.0
"""A node's part in a replay: nothing is taken before its turn, whatever comes first."""

import pytest
import rclpy
from builtin_interfaces.msg import Time
from std_msgs.msg import Header

from starpos_common.dropped import Dropped
from starpos_common.replayed import Replayed
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
        self.took, self.busy, self.ended = [], False, 0
        self.replayed = Replayed(
            node, {"tilt": self._take}, [node.create_publisher(Tilt, "made", 1)], lambda: self.busy, self._end
        )

    def _take(self, message, info):
        self.took.append((message.header.stamp.sec, self.replayed.unix_s))

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
    taking.turn(5, 3, kind=Played.END)
    assert taking.ended == 1 and not taking.replayed.playing


def test_a_beginning_that_is_said_again_takes_nothing_back(taking):
    taking.turn(0, kind=Played.BEGIN)
    taking.tilt(1), taking.turn(1, 1)
    taking.tilt(2)
    taking.turn(0, kind=Played.BEGIN)
    taking.turn(2, 2)
    assert taking.took == [(1, 101.0), (2, 102.0)]


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
    assert len(taking.took) == 1


def test_messages_that_never_came_are_counted_by_the_numbers_of_one_publisher(node):
    dropped = Dropped(node, "play it slower")
    for number in (5, 6, 9, 2, 3):
        dropped.came("tilt", {"publication_sequence_number": number})
    dropped.came("stars", {"publication_sequence_number": None})
    assert dropped.counts == {"tilt": 2}

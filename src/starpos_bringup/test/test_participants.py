# SPDX-License-Identifier: Apache-2.0
"""Whom a player waits for, and whom it gives up: no pause costs it a node that is well."""

from types import SimpleNamespace

import pytest
import rclpy

from starpos_bringup import player
from starpos_bringup.player import LOST_S, SILENCE_S, Participants
from starpos_interfaces.msg import Played, Taken
from starpos_testing.nodes import take_domain

SOLVER, DETECTOR = "/solver", "/detector"
TAKES = {SOLVER: "/stars", DETECTOR: "/camera/image_raw"}


@pytest.fixture(scope="module")
def node():
    take_domain()
    context = rclpy.Context()
    rclpy.init(context=context)
    node = rclpy.create_node("player", context=context)
    yield node
    node.destroy_node()
    rclpy.shutdown(context=context)


class Seat:
    """A player's side whose clock goes as a test wants; what nodes say comes at once."""

    def __init__(self, node, monkeypatch):
        self.now_s, self.said, self.made = 1000.0, [], dict.fromkeys(TAKES, 0)
        monkeypatch.setattr(player, "time", SimpleNamespace(monotonic=lambda: self.now_s))
        self.player = Participants(node, self.said.append)

    def hears(self, name, *, behind=0, replay=None, busy=False):
        """What a node says: that it has taken all but the last `behind` words."""
        replay = self.player._replay if replay is None else replay
        index = max(self.player._index - behind, 0) if replay else 0
        made = self.made[name]
        words = Taken(
            node=name, replay=replay, index=index, busy=busy, takes=[TAKES[name]], made=made, fixes=made
        )
        self.player._on_taken(words)

    def passes(self, seconds, *names, **words):
        """Time goes on, and these nodes say each second what they always say."""
        for _ in range(round(seconds)):
            self.now_s += 1
            for name in names:
                self.hears(name, **words)

    def begins(self, *names):
        for name in names:
            self.hears(name, replay=0)
        self.player.begin()
        for name in names:
            self.hears(name)
        assert self.player.have_taken_all()

    def asks(self):
        self.player.tell(Played.MESSAGE, 0, "/stars", answer=True)
        return self.player.have_taken_all()


@pytest.fixture
def seat(node, monkeypatch):
    return Seat(node, monkeypatch)


@pytest.mark.parametrize("heartbeats", [True, False], ids=["heard", "not heard meanwhile"])
def test_a_node_of_which_nothing_was_asked_for_long_is_waited_for(seat, heartbeats):
    seat.begins(SOLVER)
    seat.passes(LOST_S + 10, *(SOLVER,) * heartbeats)
    assert not seat.asks() and seat.said == []
    seat.hears(SOLVER)
    assert seat.player.have_taken_all() and not seat.player.lost


def test_a_node_that_waited_for_another_is_not_given_up(seat):
    seat.begins(SOLVER, DETECTOR)
    assert not seat.asks()
    seat.hears(SOLVER)
    for _ in range(round(LOST_S) + 10):
        seat.passes(1, SOLVER)
        seat.passes(1, DETECTOR, behind=1, busy=True)
    seat.hears(DETECTOR)
    assert seat.player.have_taken_all()
    assert not seat.asks() and seat.said == []


def test_a_node_to_which_a_message_was_lost_is_given_up(seat):
    seat.begins(SOLVER, DETECTOR)
    assert not seat.asks()
    seat.hears(DETECTOR)
    seat.passes(LOST_S - 1, SOLVER, behind=1)
    assert not seat.player.have_taken_all() and not seat.player.lost
    seat.passes(2, SOLVER, behind=1)
    assert seat.player.have_taken_all() and seat.player.lost
    assert seat.said == ["a message was lost on its way to /solver: it goes on without it"]


def test_a_node_that_falls_silent_is_given_up(seat):
    seat.begins(SOLVER, DETECTOR)
    assert not seat.asks()
    seat.hears(DETECTOR)
    # it was at work
    seat.passes(1, SOLVER, behind=1, busy=True)
    seat.passes(SILENCE_S, DETECTOR)
    assert not seat.player.have_taken_all()
    seat.passes(1, DETECTOR)
    assert seat.player.have_taken_all() and seat.player.lost
    assert seat.said == ["/solver has not been heard for 30 s: it goes on without it"]


@pytest.mark.parametrize(
    ("replay", "why"),
    [(0, "was started again, or did not hear the player for long"), (5, "follows another player")],
    ids=["again", "another"],
)
def test_a_node_that_takes_part_no_more_is_given_up_at_once(seat, replay, why):
    seat.begins(SOLVER)
    assert not seat.asks()
    seat.passes(1, SOLVER, replay=replay)
    assert seat.player.have_taken_all() and seat.player.lost
    assert seat.said == [f"/solver {why}: it goes on without it"]


def test_a_node_that_was_started_again_takes_part_in_the_next_replay_and_counts_from_there(seat):
    seat.begins(SOLVER)
    seat.made[SOLVER] = 7
    seat.hears(SOLVER)
    seat.made[SOLVER] = 2
    seat.passes(1, SOLVER, replay=0)
    assert seat.asks()
    seat.begins(SOLVER)
    assert not seat.asks()
    seat.made[SOLVER] = 3
    seat.hears(SOLVER)
    assert seat.player.have_taken_all() and seat.player.answers("/stars") == (8, 8)


def test_a_player_that_goes_on_tells_nothing_new(seat):
    told = []
    seat.player._publisher = SimpleNamespace(publish=told.append)
    seat.player.go_on()
    assert told == []
    seat.begins(SOLVER)
    assert not seat.asks()
    seat.player.go_on()
    assert [(m.index, m.topic, m.answer) for m in told[1:]] == [(1, "/stars", True), (1, "", False)]
    seat.hears(SOLVER)
    assert seat.player.have_taken_all()


def test_a_node_that_is_gone_before_a_replay_begins_is_not_waited_for(seat):
    seat.hears(DETECTOR, replay=0)
    seat.passes(SILENCE_S + 1)
    seat.begins(SOLVER)
    assert seat.said == []

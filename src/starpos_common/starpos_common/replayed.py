# SPDX-License-Identifier: Apache-2.0
"""A node's part in a replay: it takes the messages in the order in which they were played, and acknowledges them.

No order holds between the topics of ROS, and a clock that is played is a topic of its own.  So the player
(starpos_bringup's `replay`) announces on /replay/played each message and its time of recording; a node whose time is
simulated holds each message back until its turn, and answers on /replay/taken.
"""

import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from builtin_interfaces.msg import Time
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile

from starpos_common.topics import Take
from starpos_interfaces.msg import Played, Taken

PLAYED, TAKEN = "/replay/played", "/replay/taken"
# Many more than a player publishes before it waits for an answer.
DEPTH = 5000
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
# Intervals of repeated messages, and of checks for new ones.
HEARTBEAT_S, LOOK_S = 1.0, 0.1
# Maximum interval between a player's messages while it plays.
WORD_S = 1.0
# Silence after which a player has ended if the graph does not show it: a busy machine may lose sight of a running one.
# The graph shows a killed one for many seconds, so a longer silence alone is enough.
ENDED_S, SILENT_S = 5.0, 15.0
STRANGERS = (
    "{} messages on {} are left out, which were neither played nor made of what was: stop the node that sends them, or "
    "start it with use_sim_time, so that it takes part in the replay"
)
BROKEN_OFF = "the player ended in the middle, and {} messages are left out: play it again"


class Replayed:
    """Holds back the messages of a replay until it is their turn.

    takes: functions that take the messages of a topic, by its relative name.
    makes: the node's publishers, first the one for results of a frame, or of an IMU's messages; the node calls `note`.
    busy: whether the node still works on what it has taken; it calls `go_on` when that is done.
    begin, end: called before the first message of a replay, and when no more come.
    """

    def __init__(
        self,
        node: Node,
        takes: Mapping[str, Take],
        makes: Sequence[Publisher],
        busy: Callable[[], bool],
        begin: Callable[[], object] = lambda: None,
        end: Callable[[], object] = lambda: None,
    ) -> None:
        self.made = self.fixes = 0
        self.unix_s: float | None = None
        self._node, self._busy, self._begin, self._end = node, busy, begin, end
        self._names = {name: node.resolve_topic_name(name) for name in takes}
        self._takes = {self._names[name]: take for name, take in takes.items()}
        self._makes = makes
        self._replay = self._index = 0
        self._playing = False
        # newest index that was heard
        self._heard = 0
        # how long the player was silent while this node listened, and when this was last counted
        self._silent_s, self._beat_s = 0.0, time.monotonic()
        self._turns: deque[Played] = deque()
        self._taking: Played | None = None
        # stamps of the results of the last message taken
        self._stamps: list[Time] = []
        self._held: dict[str, deque[tuple[Any, Mapping[str, Any]]]] = {}
        node.create_subscription(Played, PLAYED, self._on_played, DEPTH)
        self._publisher = node.create_publisher(Taken, TAKEN, LATCHED)
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._heartbeat = node.create_timer(LOOK_S, self._beat, clock=steady)
        self._said_s = 0.0
        self._listeners = 0
        self._say()

    @property
    def playing(self) -> bool:
        """Whether a replay is under way: `unix_s` is its time, None before its first message."""
        return self._playing

    def holds(self, name: str, message: Any, info: Mapping[str, Any]) -> bool:
        """Keep a message of a topic until its turn; False if no replay is under way."""
        if not self._playing:
            return False
        self._held.setdefault(self._names[name], deque(maxlen=DEPTH)).append((message, info))
        self.go_on()
        return True

    def in_turn(self, name: str, take: Take) -> Take:
        """Make a topic's callback that calls `take` at once where no replay is under way."""

        def on_message(message: Any, info: Mapping[str, Any]) -> None:
            if not self.holds(name, message, info):
                take(message, info)

        return on_message

    def note(self, stamp: Time, fix: bool = False) -> None:
        """Note that something was made and published; fix: whether it is a fix."""
        self.made += 1
        self.fixes += fix
        if self._playing:
            self._stamps.append(stamp)

    def go_on(self) -> None:
        """Take all messages whose turn it is."""
        while not self._busy():
            if self._taking is not None:
                self._done(self._taking)
            if not self._turns or not self._take(self._turns[0]):
                return

    def _on_played(self, turn: Played) -> None:
        if turn.kind == Played.BEGIN:
            if turn.replay == self._replay and self._playing:
                # the player has not heard that it was taken
                self._silent_s = 0.0
                self._say()
                return
            self._leave(BROKEN_OFF)
            self._replay, self._playing, self._heard = turn.replay, True, -1
        if turn.replay == self._replay and self._playing:
            self._silent_s = 0.0
            # a number that was heard before only says that the player goes on
            if turn.index > self._heard:
                self._heard = turn.index
                self._turns.append(turn)
                self.go_on()

    def _take(self, turn: Played) -> bool:
        """Take a turn; False if its message has not come yet, or if it goes on after a job."""
        take = self._takes.get(turn.topic)
        held = self._of(turn) if take else None
        if take and held is None:
            return False
        if turn.kind != Played.BEGIN:
            self.unix_s = (turn.time.sec * 10**9 + turn.time.nanosec) * 1e-9
        self._stamps = []
        if take and held is not None:
            self._turns.popleft()
            self._taking = turn
            take(*held)
            return True
        if turn.kind == Played.BEGIN:
            self._begin()
        if turn.kind == Played.END:
            self._end()
            if self._busy():
                return False
        self._turns.popleft()
        self._taking = turn
        return True

    def _of(self, turn: Played) -> tuple[Any, Mapping[str, Any]] | None:
        """The message whose turn it is, if it has come."""
        held = self._held.get(turn.topic, deque())
        for k, (message, _) in enumerate(held):
            if message.header.stamp == turn.stamp:
                found = held[k]
                del held[k]
                return found
        return None

    def _done(self, turn: Played) -> None:
        self._taking, self._index = None, turn.index
        if turn.kind == Played.END:
            self._leave(
                STRANGERS.format("{}", ", ".join(sorted(n for n, held in self._held.items() if held)))
            )
        # nodes that do not take a topic are not waited for
        if turn.answer and (not turn.topic or turn.topic in self._takes):
            self._say()

    def _leave(self, why: str) -> None:
        """Take part no more; why: a sentence with the number of messages that wait for their turn."""
        if number := sum(map(len, self._held.values())):
            self._node.get_logger().warning(why.format(number))
        self._playing, self._taking, self.unix_s = False, None, None
        self._turns.clear()
        self._held.clear()

    def _beat(self) -> None:
        # a player that was killed will not end it
        if self._playing and self._player_is_gone():
            self._leave(BROKEN_OFF)
            # the player, should it be alive, need not wait for this node
            self._replay = self._index = 0
        listeners = sum(p.get_subscription_count() for p in self._makes)
        if listeners != self._listeners or time.monotonic() - self._said_s > HEARTBEAT_S:
            self._listeners = listeners
            self._say()

    def _player_is_gone(self) -> bool:
        now_s = time.monotonic()
        # messages sent while this node stood still are read only now
        self._silent_s += min(now_s - self._beat_s, 2 * LOOK_S)
        self._beat_s = now_s
        shown = self._node.count_publishers(PLAYED) > 0
        return self._silent_s > (SILENT_S if shown else ENDED_S)

    def _say(self) -> None:
        self._said_s = time.monotonic()
        self._publisher.publish(
            Taken(
                node=self._node.get_fully_qualified_name(),
                replay=self._replay,
                index=self._index,
                busy=self._busy(),
                takes=sorted(self._takes),
                makes=[p.topic_name for p in self._makes],
                listeners=self._listeners,
                made=self.made,
                fixes=self.fixes,
                stamps=self._stamps,
            )
        )

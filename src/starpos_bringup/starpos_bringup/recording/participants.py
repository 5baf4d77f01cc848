# SPDX-License-Identifier: Apache-2.0
"""The nodes that take part in a replay, as the player sees them (starpos_common/replayed.py is their side)."""

import random
import threading
import time
from collections.abc import Callable

from builtin_interfaces.msg import Time
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile

from starpos_common.replayed import DEPTH, PLAYED, TAKEN
from starpos_interfaces.msg import Played, Taken

# A node that is silent for longer has ended, or hangs; nodes send once a second.
SILENCE_S = 30.0
# A node that waits longer for a message that was published has lost it.
LOST_S = 30.0
# All nodes send on one topic: with a depth of one, a message that is not read yet would replace another node's.
WORDS = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class _Participant:
    """A node: its newest Taken, when that came, since when it has taken nothing new, and what it made in replays.

    gone: it is not waited for any more. left: it took part in this replay and has left it.
    """

    def __init__(self, words: Taken) -> None:
        self.words = words
        self.heard_s = self.stands_since_s = time.monotonic()
        self.gone = self.left = False
        self.made = self.fixes = 0

    def hear(self, words: Taken, replay: int) -> None:
        """Take its message; replay: the one under way."""
        self.heard_s = time.monotonic()
        before, self.words = self.words, words
        if words.busy or (words.replay, words.index) != (before.replay, before.index):
            self.stands_since_s = self.heard_s
        if replay and before.replay == replay:
            if words.replay != replay:
                self.left = True
                return
            # its earlier message may be a second old, and lack an answer to another player's frame
            self.made += words.made - before.made
            self.fixes += words.fixes - before.fixes


class Participants:
    """Informs the nodes that take part of what is played, and keeps what each has taken.

    say: takes a sentence for the person at the terminal.
    """

    def __init__(self, node: Node, say: Callable[[str], None]) -> None:
        self._node, self._say = node, say
        self._heard: dict[str, _Participant] = {}
        # the nodes of this replay; None before it begins. Later ones take part in the next.
        self._members: list[_Participant] | None = None
        self._replay, self._index = 0, -1
        # when the last question was asked, and about which topic; '': about all
        self._asked_s, self._asked_topic = 0.0, ""
        # whether one was lost on the way
        self.lost = False
        self._publisher = node.create_publisher(Played, PLAYED, DEPTH)
        # `go_on` is called by another thread
        self._speaking = threading.Lock()
        node.create_subscription(Taken, TAKEN, self._on_taken, WORDS)

    def _on_taken(self, words: Taken) -> None:
        if words.node in self._heard:
            self._heard[words.node].hear(words, self._replay)
        else:
            self._heard[words.node] = _Participant(words)

    @property
    def _present(self) -> list[_Participant]:
        known = self._heard.values() if self._members is None else self._members
        return [p for p in known if not p.gone]

    def all_here(self) -> bool:
        """Whether each node that is known to take part has been heard, hears us, and has found who listens to it."""
        known, here = self._node.count_publishers(TAKEN), self._present
        listeners = (sum(map(self._node.count_subscribers, p.words.makes)) for p in here)
        return known <= len(here) <= self._publisher.get_subscription_count() and all(
            p.words.listeners >= number for p, number in zip(here, listeners, strict=True)
        )

    def taking(self, topic: str) -> list[_Participant]:
        """The participants that take a topic."""
        return [p for p in self._present if topic in p.words.takes]

    def topics_made_of(self, topic: str) -> set[str]:
        """The topics that are made of this one: star lists of images, tilts of accelerations."""
        return {p.words.makes[0] for p in self.taking(topic) if p.words.makes}

    def newly_made(self, topic: str) -> list[tuple[str, Time]]:
        """Topics and stamps of the messages made from the newest announced one, of this topic."""
        newest = self._replay, self._index
        makers = [p for p in self.taking(topic) if (p.words.replay, p.words.index) == newest]
        return [(p.words.makes[0], stamp) for p in makers for stamp in p.words.stamps]

    def making(self, topic: str) -> list[list[str]]:
        """The inputs of each publisher of a topic."""
        return [list(p.words.takes) for p in self._present if topic in p.words.makes]

    def answers(self, topic: str) -> tuple[int, int]:
        """How many answers and fixes have come of the messages of a topic since the first replay began."""
        takers = [p for p in self._heard.values() if topic in p.words.takes]
        return sum(p.made for p in takers), sum(p.fixes for p in takers)

    def begin(self) -> None:
        """Begin a replay with the nodes that are here now, including nodes given up in the last one but heard again."""
        now_s = time.monotonic()
        self._members = [p for p in self._heard.values() if now_s - p.heard_s <= SILENCE_S]
        for p in self._members:
            p.gone = p.left = False
        with self._speaking:
            self._replay, self._index = random.getrandbits(63), -1
        self.tell(Played.BEGIN, 0, answer=True)

    def begin_again(self) -> None:
        """Announce the replay again, for a node that had not found the player before."""
        with self._speaking:
            self._publish(Played.BEGIN, 0, answer=True)

    def go_on(self) -> None:
        """Say that the player goes on: its newest number once more.  Any thread may call it."""
        with self._speaking:
            if self._index >= 0:
                self._publish(Played.MESSAGE, 0)

    def tell(
        self, kind: int, now_ns: int, topic: str = "", stamp: Time | None = None, *, answer: bool = False
    ) -> None:
        """Announce what is played; answer: ask whether it is taken."""
        if answer:
            self._asked_s, self._asked_topic = time.monotonic(), topic
        with self._speaking:
            self._index += 1
            self._publish(kind, now_ns, topic, stamp, answer=answer)

    def _publish(
        self, kind: int, now_ns: int, topic: str = "", stamp: Time | None = None, *, answer: bool = False
    ) -> None:
        sec, nanosec = divmod(now_ns, 10**9)
        self._publisher.publish(
            Played(
                replay=self._replay,
                index=self._index,
                kind=kind,
                time=Time(sec=sec, nanosec=nanosec),
                topic=topic,
                stamp=stamp or Time(),
                answer=answer,
            )
        )

    def have_taken_all(self) -> bool:
        """Whether the message in question and all before it are taken by all its remaining takers."""
        asked = self.taking(self._asked_topic) if self._asked_topic else self._present
        for p in asked:
            if (p.words.replay, p.words.index) == (self._replay, self._index):
                continue
            why = self._why_given_up(p)
            if not why:
                return False
            p.gone = self.lost = True
            self._say(f"{why}: it goes on without it")
        return True

    def _why_given_up(self, p: _Participant) -> str:
        """Why a node is not waited for any more; '' while it is."""
        now_s, name = time.monotonic(), p.words.node
        # it may be long since a node was asked anything
        if now_s - max(p.heard_s, self._asked_s) > SILENCE_S:
            return f"{name} has not been heard for {SILENCE_S:.0f} s"
        if p.left:
            other = (
                "follows another player"
                if p.words.replay
                else "was started again, or did not hear the player for long"
            )
            return f"{name} {other}"
        if now_s - max(p.stands_since_s, self._asked_s) > LOST_S:
            return f"a message was lost on its way to {name}"
        return ""

# SPDX-License-Identifier: Apache-2.0
"""Publishes the messages of a bag at the wanted pace, each frame when the nodes that take part have finished the last."""

import math
import random
import sys
import threading
import time
from collections.abc import Callable, Iterable
from typing import Any

from builtin_interfaces.msg import Time
from rclpy.context import Context
from rclpy.duration import Duration
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSCompatibility, QoSProfile, qos_check_compatible
from rclpy.serialization import deserialize_message
from rosgraph_msgs.msg import Clock

from starpos.recording.topics import IMAGE, IMU, PICTURE, STARS
from starpos_bringup.bag import Topic
from starpos_common.replayed import DEPTH, PLAYED, TAKEN, WORD_S
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


IMAGES = (IMAGE, PICTURE)
FRAMES = (STARS, *IMAGES)
CLOCK_PERIOD_S = 0.025
ACKNOWLEDGED_S = 3.0
# Maximum number of messages on their way: queues hold some hundred.
BURST = 50
# Without participants there are no acknowledgements: at rate 0 listeners get this time to empty their queues.
BURST_REST_S = 0.05
BEGIN_S, AGAIN_S = 30.0, 1.0
# Time after which missing subscribers are ignored.
FOUND_S = 10.0
# Time after the discovery of one listener within which others are found, mostly within a tenth of it.
SETTLED_S = 1.0


class Player:
    """Publishes the topics of a bag, and has the nodes that take part take them one after another.

    frames: number of frames that a solver could answer: star lists that were played, or made from played images, and
    images without a star list, unless only star lists have subscribers.
    """

    def __init__(
        self,
        topics: Iterable[Topic],
        rate: float,
        stopped: list[int],
        contexts: tuple[Context, Context],
        say: Callable[[str], None],
    ) -> None:
        self.count = self.broken = self.frames = 0
        self._rate, self._stopped, self._say = rate, stopped, say
        self._node, self._frame_node = (
            Node(name, context=context, start_parameter_services=False, enable_rosout=False)
            for name, context in zip(("replay", "replay_frames"), contexts, strict=True)
        )
        self._executor = SingleThreadedExecutor(context=contexts[0])
        self._executor.add_node(self._node)
        self._clock = self._node.create_publisher(Clock, "/clock", 10)
        by_name = {t.name: t for t in topics}
        # by the bag's name of a topic
        self._publishers = {name: self._publisher(t) for name, t in by_name.items()}
        # by the name that the graph knows it by, which the user may have remapped
        self._played = {p.topic_name: p for p in self._publishers.values()}
        kinds = {self._publishers[name].topic_name: t.type_name for name, t in by_name.items()}
        self._frame_topics = [name for name, kind in kinds.items() if kind in FRAMES]
        self._imu_topics = [name for name, kind in kinds.items() if kind == IMU]
        # topics of star lists, which a solver answers
        self._star_topics = {name for name, kind in kinds.items() if kind == STARS}
        self._participants = Participants(self._node, say)
        self._listeners: list[int] = []
        self._unchanged_since_s = -math.inf
        self._now_ns: int | None = None
        # what /clock said last
        self._ticked_ns = 0
        self._show = sys.stderr.isatty()
        self._shown_s = 0.0
        # a thread of its own: the bag's next message may be long in coming from a slow disk
        self._over = threading.Event()
        self._voice = threading.Thread(target=self._go_on, name="voice", daemon=True)
        self._voice.start()

    def _go_on(self) -> None:
        while not self._over.wait(WORD_S):
            self._participants.go_on()

    def _publisher(self, topic: Topic) -> Publisher:
        # An image may have 42 MB.
        large = topic.type_name.endswith("Image")
        durability = DurabilityPolicy.TRANSIENT_LOCAL if topic.latched else DurabilityPolicy.VOLATILE
        profile = QoSProfile(depth=2 if large else 1000, durability=durability)
        node = self._frame_node if large else self._node
        # a subscription of another QoS is no reason for rclpy's warning: a node hears latched topics by two
        silent = PublisherEventCallbacks(use_default_callbacks=False)
        return node.create_publisher(topic.kind, topic.name, profile, event_callbacks=silent)

    @property
    def answers(self) -> tuple[int, int]:
        """How many answers and fixes the solvers have given."""
        told = [self._participants.answers(topic) for topic in sorted(self._star_topics)]
        return max((a for a, _ in told), default=0), max((f for _, f in told), default=0)

    @property
    def lost(self) -> bool:
        """Whether a node that took part did not take all."""
        return self._participants.lost

    def wait(self, at_most_s: float, *, for_solver: bool) -> None:
        """Wait until all listeners are found, or time is up; then report missing ones and other publishers.

        for_solver: wait for nodes that take part, too, from the frames to the solver.
        """
        self._spin(at_most_s, lambda: self._all_listen() and (not for_solver or self._chain()))
        # participants may not be heard yet, nor listeners found
        self._spin(min(at_most_s, FOUND_S), self._settled)
        heard = [n for n in self._frame_topics if self._played[n].get_subscription_count()]
        if self._frame_topics and not heard and not self._stopped:
            self._say(
                f"no node subscribes to {', '.join(self._frame_topics)}: start detector or solver in its "
                f"namespace, with "
                "use_sim_time, or remap (--ros-args -r)"
            )
        elif self._frame_topics and not any(map(self._participants.taking, heard)):
            self._say(
                f"the subscribers of {', '.join(heard)} do not report what they take: start detector and "
                f"solver with "
                "use_sim_time"
            )
        self._say_doubled()

    def _say_doubled(self) -> None:
        """Say which topics come twice: from another node too, or made again of what is played."""
        makers = {n: self._participants.making(n) for n in self._played}
        others = [n for n, known in makers.items() if self._node.count_publishers(n) > 1 + len(known)]
        if others:
            self._say(
                f"{', '.join(others)} is published by another node too: both are heard; --topics leaves it out"
            )
        frames = {*self._frame_topics, *self._made_of_frames()}
        again = [n for n, known in makers.items() if any(frames & set(takes) for takes in known)]
        if again:
            self._say(
                f"{', '.join(again)} is in the bag, and is made again of what is played: what is in both comes twice; "
                "--inputs stars, or images, plays it once"
            )

    def _made_of_frames(self) -> set[str]:
        return {makes for n in self._frame_topics for makes in self._participants.topics_made_of(n)}

    def _all_listen(self) -> bool:
        every = [*self._publishers.values(), self._clock]
        return all(p.get_subscription_count() for p in every)

    def _chain(self) -> bool:
        """Whether the frames, the star lists made from them, and any accelerations have takers."""
        makers = self._made_of_frames()
        solvers = [*self._star_topics, *makers]
        takers = self._participants.taking
        return bool(makers) and any(map(takers, solvers)) and all(map(takers, self._imu_topics))

    def _all_found(self) -> bool:
        """Whether each subscription that the graph shows, and whose QoS fits, is matched."""
        return self._participants.all_here() and all(
            p.get_subscription_count() >= self._could_hear(name, p) for name, p in self._played.items()
        )

    def _settled(self) -> bool:
        """Whether all listeners are found, and no new one has come for SETTLED_S."""
        listeners = [self._node.count_subscribers(name) for name in self._played]
        if listeners != self._listeners:
            self._listeners, self._unchanged_since_s = listeners, time.monotonic()
        return self._all_found() and time.monotonic() - self._unchanged_since_s >= SETTLED_S

    def _could_hear(self, name: str, publisher: Publisher) -> int:
        """How many subscriptions accept the publisher's quality of service."""
        known = self._node.get_subscriptions_info_by_topic(name)
        verdicts = [qos_check_compatible(publisher.qos_profile, s.qos_profile)[0] for s in known]
        return sum(verdict != QoSCompatibility.ERROR for verdict in verdicts)

    def start_round(self) -> None:
        """Begin a replay with those who take part."""
        self._now_ns, self._ticked_ns = None, 0
        self._first_ns: int | None = None
        self._participants.begin()
        end_s = time.monotonic() + BEGIN_S
        while not self._spin(AGAIN_S, self._participants.have_taken_all) and not self._stopped:
            if time.monotonic() > end_s:
                break
            self._participants.begin_again()
        self._begin_s = time.monotonic()

    def end_round(self) -> None:
        """End it, and let the last messages arrive before the publishers go."""
        self._participants.tell(Played.END, self._now_ns or 0, answer=True)
        if self._stopped:
            return
        self._taken()
        for publisher in (*self._publishers.values(), self._clock):
            publisher.wait_for_all_acked(Duration(seconds=ACKNOWLEDGED_S))

    def play(self, topic: Topic, log_ns: int, data: bytes) -> None:
        """Publish one message when its time has come; a broken one is counted and left out."""
        try:
            message = deserialize_message(data, topic.kind)
        except Exception:
            # Besides RMWError, hostile bytes may cause any error of a conversion.
            self.broken += 1
            if self.broken == 1:
                self._say(f"a message of {topic.name} is broken and left out, as are others like it")
            return
        self._pace(log_ns, often=topic.type_name == IMU)
        if self._stopped:
            return
        publisher = self._publishers[topic.name]
        publisher.publish(data)
        self.count += 1
        made, taken = False, bool(self._participants.taking(publisher.topic_name))
        if taken:
            made = self._agree(publisher.topic_name, message.header.stamp, topic.type_name in FRAMES)
        elif self._rate == 0 and self.count % BURST == 0:
            self._spin(BURST_REST_S)
        if topic.type_name == STARS or (
            topic.type_name in IMAGES and (taken or not self._frames_are_taken())
        ):
            self.frames += not made
        self._progress()

    def _frames_are_taken(self) -> bool:
        return any(map(self._participants.taking, self._frame_topics))

    def _agree(self, topic: str, stamp: Any, is_frame: bool) -> bool:
        """Wait until the nodes have taken a message, and then what they made of it; return whether star lists came."""
        # results of this message that other nodes take have their turn before the next message
        links = any(map(self._participants.taking, self._participants.topics_made_of(topic)))
        answer = is_frame or links or self.count % BURST == 0
        self._tell(topic, stamp, answer)
        if not answer:
            return False
        self._taken()
        if topic in self._star_topics or not (is_frame or links):
            return False
        made_any = False
        for makes, made_stamp in self._participants.newly_made(topic):
            if is_frame:
                made_any = True
                self._star_topics.add(makes)
                self.frames += 1
            self._tell(makes, made_stamp, answer=is_frame)
            if is_frame:
                self._taken()
        return made_any

    def _tell(self, topic: str, stamp: Any, answer: bool) -> None:
        assert self._now_ns is not None
        self._participants.tell(Played.MESSAGE, self._now_ns, topic, stamp, answer=answer)

    def _taken(self) -> None:
        """Wait until the nodes have taken all that was played; one that hangs is given up, which ends the wait."""
        while not self._spin(1.0, self._participants.have_taken_all) and not self._stopped:
            pass

    def _pace(self, log_ns: int, often: bool) -> None:
        """Wait for the time of a message; often: often: one of several for which the clock need not tick each time."""
        if self._first_ns is None:
            self._first_ns = log_ns
        while self._rate and not self._stopped:
            # Time never goes back within a round, even if the times of a bag's messages do.
            elapsed_ns = max(log_ns - self._first_ns, 0)
            left_s = self._begin_s + elapsed_ns * 1e-9 / self._rate - time.monotonic()
            if left_s <= 0:
                break
            self._spin(min(left_s, CLOCK_PERIOD_S))
            passed_ns = int((time.monotonic() - self._begin_s) * self._rate * 1e9)
            self._tick(min(self._first_ns + passed_ns, log_ns))
        self._tick(log_ns, CLOCK_PERIOD_S if often else 0.0)

    def _tick(self, now_ns: int, least_s: float = 0.0) -> None:
        """Go on to a time; it is published unless the clock was published within some seconds before."""
        if self._now_ns is not None and now_ns <= self._now_ns:
            return
        self._now_ns = now_ns
        if now_ns - self._ticked_ns < least_s * 1e9:
            return
        self._ticked_ns = now_ns
        message = Clock()
        message.clock.sec, message.clock.nanosec = divmod(now_ns, 10**9)
        self._clock.publish(message)

    def _spin(self, seconds: float, until: Callable[[], bool] = lambda: False) -> bool:
        end = time.monotonic() + seconds
        while not self._stopped and not until():
            left_s = end - time.monotonic()
            if left_s <= 0:
                return False
            self._executor.spin_once(timeout_sec=min(left_s, 0.05))
        return True

    def _progress(self) -> None:
        if self._now_ns is None or self._first_ns is None:
            return
        if self._show and time.monotonic() - self._shown_s >= 1.0:
            self._shown_s = time.monotonic()
            self._say(f"{(self._now_ns - self._first_ns) * 1e-9:.0f} s of the bag, {self.count} messages")

    def close(self) -> None:
        """End the nodes."""
        self._over.set()
        self._voice.join()
        self._executor.shutdown()
        self._node.destroy_node()
        self._frame_node.destroy_node()

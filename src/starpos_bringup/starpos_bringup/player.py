# SPDX-License-Identifier: Apache-2.0
"""Publishes the messages of a bag at the wanted pace, with /clock, no further ahead than detector and solver follow."""

import math
import sys
import time
from collections import deque
from collections.abc import Callable, Iterable

from rclpy.context import Context
from rclpy.duration import Duration
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.serialization import deserialize_message
from rosgraph_msgs.msg import Clock

from starpos.recording.topics import FRAMES, IMAGES, IMU, SOLUTION, STARS
from starpos_bringup.bag import Topic
from starpos_interfaces.msg import Solution, StarArray

CLOCK_PERIOD_S = 0.025
ACKNOWLEDGED_S = 3.0
# How far the bag's time goes on beyond a frame that is not answered: solver and detector wait for later messages.
AHEAD_S = 5.0
# A clock set back makes nodes forget; they hear of it in this time, before the first message of a round.
BEGUN_S = 0.5
# How long an answer is waited for, and how often that may be in vain.
PATIENCE_S, MAX_IN_VAIN = 30.0, 2
# At rate 0 listeners get this time after each burst to empty their queues, which hold some hundred messages.
BURST, BURST_REST_S = 50, 0.02
# Time after which missing subscribers are ignored.
FOUND_S = 10.0
# Time after the discovery of one listener within which others are found, mostly within a tenth of it.
SETTLED_S = 1.0
QUEUE = 100


class Player:
    """Publishes the topics of a bag, and hears how far the solvers and detectors are with its frames.

    frames: number of frames that a solver could answer: star lists, and images unless only star lists have subscribers.
    answers, fixes: of the solvers.  lost: how often an answer was waited for in vain.
    """

    def __init__(
        self,
        topics: Iterable[Topic],
        rate: float,
        stopped: list[int],
        contexts: tuple[Context, Context],
        say: Callable[[str], None],
    ) -> None:
        self.count = self.broken = self.frames = self.answers = self.fixes = 0
        self._rate, self._stopped, self._say = rate, stopped, say
        self._node, self._frame_node = (
            Node(name, context=context, start_parameter_services=False, enable_rosout=False)
            for name, context in zip(("replay", "replay_frames"), contexts, strict=True)
        )
        self._executor = SingleThreadedExecutor(context=contexts[0])
        self._executor.add_node(self._node)
        self._clock = self._node.create_publisher(Clock, "/clock", 10)
        topics = tuple(topics)
        # by the bag's name of a topic
        self._publishers = {t.name: self._publisher(t) for t in topics}
        self._every = (*self._publishers.values(), self._clock)
        self._frame_publishers = [self._publishers[t.name] for t in topics if t.type_name in FRAMES]
        # by the name that the graph knows it by, which the user may have remapped
        self._played = {p.topic_name for p in self._publishers.values()}
        # topics of solutions and of star lists that are made of what is played
        self._solutions: set[str] = set()
        self._made_stars: set[str] = set()
        # the bag's times (ns) of the frames that a solver has not answered yet; images that a detector has not searched
        self._unanswered: deque[int] = deque()
        self._unsearched = 0
        self.lost = 0
        # topics that are played, and published by another node too
        self._doubled: list[str] = []
        self._listeners: list[int] = []
        self._unchanged_since_s = -math.inf
        self._now_ns: int | None = None
        # what /clock said last
        self._ticked_ns = 0
        self._show = sys.stderr.isatty()
        self._shown_s = 0.0

    def _publisher(self, topic: Topic) -> Publisher:
        # An image may have 42 MB.
        large = topic.type_name.endswith("Image")
        durability = DurabilityPolicy.TRANSIENT_LOCAL if topic.latched else DurabilityPolicy.VOLATILE
        profile = QoSProfile(depth=2 if large else 1000, durability=durability)
        node = self._frame_node if large else self._node
        # a subscription of another QoS is no reason for rclpy's warning: a node hears latched topics by two
        silent = PublisherEventCallbacks(use_default_callbacks=False)
        return node.create_publisher(topic.kind, topic.name, profile, event_callbacks=silent)

    def wait(self, at_most_s: float, *, for_solver: bool) -> None:
        """Wait until all listeners are found, or time is up; then report missing ones and other publishers.

        for_solver: wait for a solver, too, and for a detector of images.
        """
        self._spin(at_most_s, lambda: self._all_listen() and (not for_solver or self._chain()))
        # listeners may not be found yet
        self._spin(min(at_most_s, FOUND_S), self._settled)
        if self._stopped or not self._frame_publishers:
            return
        if not _are_heard(self._frame_publishers):
            names = ", ".join(p.topic_name for p in self._frame_publishers)
            self._say(
                f"no node subscribes to {names}: start detector or solver in its namespace, with use_sim_time, or remap "
                "(--ros-args -r)"
            )
        elif not self._solutions:
            self._say("no solver publishes solutions: start one with use_sim_time")
        self._doubled = sorted(n for n in self._played if self._node.count_publishers(n) > 1)
        if self._doubled:
            self._say(
                f"of the bag, another node publishes {', '.join(self._doubled)}, too: both are heard; --inputs stars, or "
                "images, plays only what is not made again"
            )

    def _all_listen(self) -> bool:
        return all(p.get_subscription_count() for p in self._every)

    def _chain(self) -> bool:
        """Whether a solver is there, and star lists are played or made."""
        self._find()
        played = any(p.msg_type is StarArray for p in self._frame_publishers)
        return bool(self._solutions and (played or self._made_stars))

    def _find(self) -> None:
        """Listen to the solutions, and to the star lists, that other nodes make."""
        kinds = ((SOLUTION, Solution, self._solutions), (STARS, StarArray, self._made_stars))
        for name, types in self._node.get_topic_names_and_types():
            for type_name, kind, found in kinds:
                new = type_name in types and name not in found | self._played
                if new and self._node.count_publishers(name):
                    found.add(name)
                    hear = self._on_solution if kind is Solution else self._on_stars
                    self._node.create_subscription(kind, name, hear, QUEUE, raw=kind is StarArray)

    def _on_solution(self, message: Solution) -> None:
        self.answers += 1
        self.fixes += message.status == Solution.OK
        if self._unanswered:
            self._unanswered.popleft()

    def _on_stars(self, data: bytes) -> None:
        self._unsearched = max(self._unsearched - 1, 0)
        if self._solutions:
            self._unanswered.append(self._now_ns or 0)

    def _settled(self) -> bool:
        """Whether no new listener has come for SETTLED_S, and those in the graph are matched."""
        self._find()
        listeners = [self._node.count_subscribers(p.topic_name) for p in self._every]
        if listeners != self._listeners:
            self._listeners, self._unchanged_since_s = listeners, time.monotonic()
        return time.monotonic() - self._unchanged_since_s >= SETTLED_S

    def start_round(self) -> None:
        self._now_ns, self._ticked_ns = None, 0
        self._first_ns: int | None = None
        self._begin_s = time.monotonic()

    def end_round(self) -> None:
        """Let the last frames be answered, while time goes on, and the last messages arrive before the publishers go."""

        def over() -> bool:
            self._tick((self._now_ns or 0) + int(CLOCK_PERIOD_S * 1e9))
            return not self._unanswered

        if self._unanswered and not self._await(over):
            self._unanswered.clear()
        if not self._stopped:
            for publisher in self._every:
                publisher.wait_for_all_acked(Duration(seconds=ACKNOWLEDGED_S))

    def play(self, topic: Topic, log_ns: int, data: bytes) -> None:
        """Publish one message when its time has come; a broken one is counted and left out."""
        try:
            deserialize_message(data, topic.kind)
        except Exception:
            # Besides RMWError, hostile bytes may cause any error of a conversion.
            self.broken += 1
            if self.broken == 1:
                self._say(f"a message of {topic.name} is broken and left out, as are others like it")
            return
        self._keep_back(log_ns)
        self._pace(log_ns, often=topic.type_name == IMU)
        if self._stopped:
            return
        publisher = self._publishers[topic.name]
        publisher.publish(data)
        self.count += 1
        if topic.type_name in FRAMES:
            self._follow(topic, publisher)
        elif self._rate == 0 and self.count % BURST == 0:
            self._spin(BURST_REST_S)
        self._progress()

    def _follow(self, topic: Topic, publisher: Publisher) -> None:
        """Count a frame; wait until a detector has searched an image, as it keeps only the newest."""
        heard = _are_heard([publisher])
        is_image = topic.type_name in IMAGES
        self.frames += not is_image or heard or not _are_heard(self._frame_publishers)
        if not heard:
            return
        if is_image and self._made_stars:
            self._unsearched = 1
            if not self._await(lambda: not self._unsearched):
                self._unsearched = 0
        elif self._solutions and (not is_image or self._doubled):
            self._unanswered.append(self._now_ns or 0)

    def _keep_back(self, log_ns: int) -> None:
        """Go on no faster than real time while a frame is not answered, and no further than AHEAD_S beyond it.

        Nodes wait for what others make, such as tilts of accelerations, by this clock.
        """
        if self._unanswered and self._now_ns is not None:
            self._spin(min((log_ns - self._now_ns) * 1e-9, AHEAD_S), lambda: not self._unanswered)
        before_ns = log_ns - int(AHEAD_S * 1e9)
        if self._unanswered and self._unanswered[0] < before_ns:
            done = self._await(lambda: not self._unanswered or self._unanswered[0] >= before_ns)
            if not done:
                self._unanswered.clear()

    def _await(self, done: Callable[[], bool]) -> bool:
        """Wait for nodes that follow, without time going on; False if they do not in PATIENCE_S, which is said."""
        if self.lost >= MAX_IN_VAIN:
            return False
        waits_s = time.monotonic()
        came = self._spin(PATIENCE_S, done)
        self._begin_s += time.monotonic() - waits_s
        if came or self._stopped:
            return True
        self.lost += 1
        self._say(f"a frame was not answered in {PATIENCE_S:.0f} s: it goes on without the answer")
        return False

    def _pace(self, log_ns: int, often: bool) -> None:
        """Wait for the time of a message; often: one of several for which the clock need not tick each time."""
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
        begins, self._now_ns = self._now_ns is None, now_ns
        if now_ns - self._ticked_ns < least_s * 1e9:
            return
        self._ticked_ns = now_ns
        message = Clock()
        message.clock.sec, message.clock.nanosec = divmod(now_ns, 10**9)
        self._clock.publish(message)
        if begins:
            self._spin(BEGUN_S)
            self._begin_s += BEGUN_S

    def _spin(self, seconds: float, until: Callable[[], bool] = lambda: False) -> bool:
        end = time.monotonic() + seconds
        while not self._stopped and not until():
            left_s = end - time.monotonic()
            if left_s <= 0:
                return False
            self._executor.spin_once(timeout_sec=min(left_s, CLOCK_PERIOD_S))
        return True

    def _progress(self) -> None:
        if self._now_ns is None or self._first_ns is None:
            return
        if self._show and time.monotonic() - self._shown_s >= 1.0:
            self._shown_s = time.monotonic()
            self._say(f"{(self._now_ns - self._first_ns) * 1e-9:.0f} s of the bag, {self.count} messages")

    def close(self) -> None:
        self._executor.shutdown()
        self._node.destroy_node()
        self._frame_node.destroy_node()


def _are_heard(publishers: Iterable[Publisher]) -> bool:
    return any(p.get_subscription_count() for p in publishers)

# SPDX-License-Identifier: Apache-2.0
"""`ros2 run starpos_bringup replay BAG`: play a rosbag2 into the running graph, byte for byte, with its time on /clock.

For machines without `ros2 bag play`, and to play as fast as the solver answers, with the same result, which that cannot.
"""

import argparse
import math
import signal
import sys
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from starpos.errors import BagError, StarposError
from starpos_bringup.recording.bag import Bag, Topic

if TYPE_CHECKING:
    from rclpy.context import Context
    from rclpy.publisher import Publisher

SIGNALS = (signal.SIGINT, signal.SIGTERM)
PLAYED, CUT_SHORT, REFUSED = 0, 1, 2  # exit statuses
FRAMES = ("sensor_msgs/msg/Image", "starpos_interfaces/msg/StarArray")
# These must not overtake the solution of the frame before.
HELD = (*FRAMES, "sensor_msgs/msg/CameraInfo")
SOLUTION = "solver/solution"
# The topic that must be there, and others.
INPUTS = {
    "stars": ("stars", ("camera/camera_info", "tilt")),
    "images": ("camera/image_raw", ("camera/camera_info", "camera/capture", "tilt")),
}
WAIT_S, WAIT_FOR_INPUTS_S = 3.0, 30.0
CLOCK_PERIOD_S = 0.025
# The solver's own patience with a frame is far shorter.
ANSWER_S = 3.0
# After so many frames of a topic in a row without an answer none is expected any more.
UNANSWERED = 3
ACKNOWLEDGED_S = 3.0
# At rate 0: no faster than subscribers empty their queues of some hundred messages.
BURST, BURST_REST_S = 100, 0.05


def replay() -> int:
    """Run the executable."""
    stopped: list[int] = []
    for number in SIGNALS:
        signal.signal(number, lambda signum, frame: stopped.append(signum))
    try:
        return main(sys.argv[1:], stopped)
    finally:
        for number in SIGNALS:
            signal.signal(number, signal.SIG_IGN)


def main(arguments: list[str], stopped: list[int]) -> int:
    """Play to the end, or until a signal handler puts something into `stopped`; return the exit status."""
    ours, ros = _split(arguments)
    options = _parser().parse_args(ours)
    try:
        with Bag(options.bag) as bag:
            wanted = bag.inputs(*INPUTS[options.inputs]) if options.inputs else options.topics
            topics = bag.topics(wanted, left_out=_say)
            return 0 if stopped else _play(bag, topics, options, ros, stopped)
    except StarposError as error:
        _say(str(error))
        return REFUSED


def _split(arguments: list[str]) -> tuple[list[str], list[str]]:
    """Split the arguments into ours and rclpy's, which begin with `--ros-args`."""
    k = arguments.index("--ros-args") if "--ros-args" in arguments else len(arguments)
    return arguments[:k], arguments[k:]


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="replay",
        description="Play a rosbag2 (a folder, or one .mcap or .db3 file) into the running graph, with /clock from "
        "the time it was recorded at: start the nodes with -p use_sim_time:=true.",
        epilog="Exit status: 0 played, 1 cut short, 2 a bad call or a bag that cannot be read.",
    )
    parser.add_argument("bag", type=Path, metavar="BAG")
    parser.add_argument(
        "--rate",
        type=_rate,
        default=1.0,
        metavar="R",
        help="times real time (1); 0: as fast as it is taken, each frame after the solution of the one before",
    )
    some = parser.add_mutually_exclusive_group()
    some.add_argument("--topics", nargs="+", metavar="TOPIC", help="only these (all)")
    some.add_argument(
        "--inputs",
        choices=tuple(INPUTS),
        help="only what a solver takes (stars), or detector and solver (images), in whatever namespace; not what they "
        "gave then",
    )
    parser.add_argument("--loop", action="store_true", help="again and again; the time begins anew as well")
    parser.add_argument(
        "--wait",
        type=_rate,
        metavar="S",
        help="at most so long for each topic's subscriber (3; with --inputs 30)",
    )
    return parser


def _rate(text: str) -> float:
    value = float(text)
    if not (math.isfinite(value) and value >= 0):
        raise argparse.ArgumentTypeError(f"{text} is not a number of at least 0")
    return value


def _say(sentence: str) -> None:
    print(f"replay: {' '.join(sentence.split())}", file=sys.stderr, flush=True)


def _play(
    bag: Bag, topics: dict[int, Topic], options: argparse.Namespace, ros: list[str], stopped: list[int]
) -> int:
    import rclpy
    from rclpy.signals import SignalHandlerOptions

    # Frames have a participant of their own, as a camera has. Otherwise they would fill the shared memory of the other
    # messages, and a lost message is repeated only a second later.
    contexts = rclpy.Context(), rclpy.Context()
    try:
        for context in contexts:
            rclpy.init(args=ros, context=context, signal_handler_options=SignalHandlerOptions.NO)
    except Exception as error:
        # The --ros-args are wrong; rcl has an error class for each.
        raise StarposError(str(error)) from None
    try:
        player = Player(topics.values(), options.rate, stopped, contexts)
        try:
            return _rounds(player, bag, topics, options, stopped)
        finally:
            player.close()
    finally:
        for context in contexts:
            context.try_shutdown()


def _rounds(
    player: "Player", bag: Bag, topics: dict[int, Topic], options: argparse.Namespace, stopped: list[int]
) -> int:
    patience_s = WAIT_FOR_INPUTS_S if options.inputs else WAIT_S
    player.wait_for_subscribers(patience_s if options.wait is None else options.wait)
    begin, status = time.monotonic(), PLAYED
    while not stopped:
        before = player.count
        player.start_round()
        try:
            for topic, log_ns, data in bag.messages(topics):
                player.play(topic, log_ns, data)
                if stopped:
                    break
        except BagError as error:
            _say(str(error))
            status = CUT_SHORT
        if not options.loop or status or player.count == before:
            break
    player.finish()
    broken = f", {player.broken} broken ones left out" if player.broken else ""
    _say(f"{player.count} messages in {time.monotonic() - begin:.1f} s{broken}")
    return status if stopped or player.count else CUT_SHORT


class Player:
    """Publishes the topics of a bag at the wanted pace."""

    def __init__(
        self, topics: Iterable[Topic], rate: float, stopped: list[int], contexts: "tuple[Context, Context]"
    ) -> None:
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.node import Node
        from rosgraph_msgs.msg import Clock

        self.count = self.broken = 0
        self._rate, self._stopped = rate, stopped
        self._node, self._frame_node = (
            Node(name, context=context, start_parameter_services=False, enable_rosout=False)
            for name, context in zip(("replay", "replay_frames"), contexts, strict=True)
        )
        self._executor = SingleThreadedExecutor(context=contexts[0])
        self._executor.add_node(self._node)
        self._clock_type = Clock
        self._clock = self._node.create_publisher(Clock, "/clock", 10)
        topics = list(topics)
        self._publishers = {t.name: self._publisher(t) for t in topics}
        self._frame_topics = [t.name for t in topics if t.type_name in FRAMES]
        self._answers = 0
        # Topic and stamp of the frame whose solution has not come yet.
        self._awaited: tuple[str, tuple[int, int]] | None = None
        self._unanswered: dict[str, int] = {}
        self._solution_topic = self._node.resolve_topic_name(SOLUTION)
        if rate == 0 and self._solution_topic not in self._publishers:
            self._listen()
        self._show = sys.stderr.isatty()
        self._shown_s = 0.0

    def _publisher(self, topic: Topic) -> "Publisher":
        from rclpy.qos import DurabilityPolicy, QoSProfile

        # An image may have 42 MB.
        large = topic.type_name.endswith("Image")
        durability = DurabilityPolicy.TRANSIENT_LOCAL if topic.latched else DurabilityPolicy.VOLATILE
        profile = QoSProfile(depth=2 if large else 1000, durability=durability)
        return (self._frame_node if large else self._node).create_publisher(topic.kind, topic.name, profile)

    def _listen(self) -> None:
        from starpos_interfaces.msg import Solution

        def hear(message: Any) -> None:
            stamp = (message.header.stamp.sec, message.header.stamp.nanosec)
            if self._awaited and stamp == self._awaited[1]:
                self._unanswered[self._awaited[0]] = 0
                self._awaited = None

        self._node.create_subscription(Solution, SOLUTION, hear, 10)

    def wait_for_subscribers(self, at_most_s: float) -> None:
        """Wait until every topic has a subscriber, or the time is over; then report missing ones and other publishers."""
        every = [*self._publishers.values(), self._clock]
        self._spin(at_most_s, lambda: all(p.get_subscription_count() for p in every))
        heard = [n for n in self._frame_topics if self._publishers[n].get_subscription_count()]
        if self._frame_topics and not heard and not self._stopped:
            _say(
                f"nobody subscribes to {', '.join(self._frame_topics)}: start detector or solver in its namespace, with "
                "use_sim_time, or remap (--ros-args -r)"
            )
        doubled = [n for n in self._publishers if self._node.count_publishers(n) > 1]
        if doubled:
            _say(
                f"{', '.join(doubled)} is published by another node too: both are heard; --topics leaves it out"
            )

    def start_round(self) -> None:
        self._now_ns: int | None = None
        self._first_ns: int | None = None
        self._begin_s = time.monotonic()

    def play(self, topic: Topic, log_ns: int, data: bytes) -> None:
        """Publish one message when its time has come; a broken one is counted and left out."""
        from rclpy.serialization import deserialize_message

        try:
            message = deserialize_message(data, topic.kind)
        except Exception:
            # Besides RMWError, hostile bytes may cause any error of a conversion.
            self.broken += 1
            if self.broken == 1:
                _say(f"a message of {topic.name} is broken and left out, as are others like it")
            return
        self._pace(topic, log_ns)
        if self._stopped:
            return
        publisher = self._publishers[topic.name]
        if topic.type_name in FRAMES and self._rate == 0 and publisher.get_subscription_count():
            self._awaited = (topic.name, (message.header.stamp.sec, message.header.stamp.nanosec))
        publisher.publish(data)
        self.count += 1
        if self._rate == 0 and self.count % BURST == 0:
            self._spin(BURST_REST_S)
        self._progress()

    def _pace(self, topic: Topic, log_ns: int) -> None:
        if self._first_ns is None:
            self._first_ns = log_ns
        if self._rate == 0 and topic.type_name in HELD:
            self._hold()
        while self._rate and not self._stopped:
            # Time never goes back within a round, even if the times of a bag's messages do.
            elapsed_ns = max(log_ns - self._first_ns, 0)
            left_s = self._begin_s + elapsed_ns * 1e-9 / self._rate - time.monotonic()
            if left_s <= 0:
                break
            self._spin(min(left_s, CLOCK_PERIOD_S))
            passed_ns = int((time.monotonic() - self._begin_s) * self._rate * 1e9)
            self._tick(min(self._first_ns + passed_ns, log_ns))
        self._tick(log_ns)

    def _hold(self) -> None:
        """Wait for the solution of the last frame, but not for ever, and not if the solver never answers."""
        if self._awaited is None:
            return
        topic = self._awaited[0]
        expected = self._unanswered.get(topic, 0) < UNANSWERED
        if expected and self._node.count_publishers(self._solution_topic):
            if self._spin(ANSWER_S, lambda: self._awaited is None):
                return
            self._unanswered[topic] = self._unanswered.get(topic, 0) + 1
        self._awaited = None

    def _tick(self, now_ns: int) -> None:
        if self._now_ns is not None and now_ns <= self._now_ns:
            return
        self._now_ns = now_ns
        message = self._clock_type()
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
            _say(f"{(self._now_ns - self._first_ns) * 1e-9:.0f} s of the bag, {self.count} messages")

    def finish(self) -> None:
        """Let the last messages arrive, and the last frame be answered, before the publishers go."""
        from rclpy.duration import Duration

        if self._stopped:
            return
        if self._rate == 0:
            self._hold()
        for publisher in (*self._publishers.values(), self._clock):
            publisher.wait_for_all_acked(Duration(seconds=ACKNOWLEDGED_S))

    def close(self) -> None:
        self._executor.shutdown()
        self._node.destroy_node()
        self._frame_node.destroy_node()

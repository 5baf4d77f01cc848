# SPDX-License-Identifier: Apache-2.0
"""`ros2 run starpos_bringup replay BAG`: play a rosbag2 into the running graph, byte for byte, with its time on /clock.

For machines without `ros2 bag play`, and to play as fast as the solver answers, which `ros2 bag play` cannot.
"""

import argparse
import sys
import time
from contextlib import ExitStack
from typing import TYPE_CHECKING

from starpos.errors import BagError, FrameError, StarposError
from starpos.recording.topics import RAW, remaps_of
from starpos_bringup.bag import Bag, Topic
from starpos_bringup.record import parser_of
from starpos_common.node_main import own_arguments, stop_signals

if TYPE_CHECKING:
    from starpos_bringup.player import Player

# Exit statuses.
PLAYED, CUT_SHORT, REFUSED = 0, 1, 2
# The topic that must be there, and others.
INPUTS = {
    "stars": ("stars", ("camera/camera_info", "tilt", "gnss/fix", "trails")),
    "images": (RAW, ("camera/camera_info", "camera/capture", "tilt", "gnss/fix")),
}
WAIT_S, WAIT_FOR_INPUTS_S = 3.0, 30.0


def replay() -> int:
    with stop_signals() as stopped:
        return main(sys.argv[1:], stopped)


def main(arguments: list[str], stopped: list[int]) -> int:
    """Play to the end, or until a signal handler puts something into `stopped`; return the exit status."""
    ours, ros = own_arguments(arguments)
    options = parser_of("replay").parse_args(ours)
    try:
        with Bag(options.bag) as bag:
            remaps = remaps_of(options.remap)
            if remaps and options.inputs != "images":
                raise FrameError("--remap names a bag's images and accelerations: give --inputs images")
            wanted = bag.inputs(*INPUTS[options.inputs], remaps) if options.inputs else options.topics
            if options.inputs:
                _say(f"playing {', '.join(wanted)}")
            topics = bag.topics(wanted, left_out=_say)
            return 0 if stopped else _play(bag, topics, options, ros, stopped)
    except StarposError as error:
        _say(str(error))
        return REFUSED


def _say(sentence: str) -> None:
    print(f"replay: {' '.join(sentence.split())}", file=sys.stderr, flush=True)


def _play(
    bag: Bag, topics: dict[int, Topic], options: argparse.Namespace, ros: list[str], stopped: list[int]
) -> int:
    import rclpy
    from rclpy.signals import SignalHandlerOptions

    from starpos_bringup.player import Player

    # Frames have a participant of their own, as a camera has. Otherwise they would fill the shared memory of the other
    # messages, and a lost message is repeated only a second later.
    contexts = rclpy.Context(), rclpy.Context()
    with ExitStack() as stack:
        for context in contexts:
            stack.callback(context.try_shutdown)
            try:
                rclpy.init(args=ros, context=context, signal_handler_options=SignalHandlerOptions.NO)
            except Exception as error:
                # The --ros-args are wrong; rcl has an error class for each.
                raise StarposError(str(error)) from None
        player = Player(topics.values(), options.rate, stopped, contexts, _say)
        stack.callback(player.close)
        return _rounds(player, bag, topics, options, stopped)


def _rounds(
    player: "Player", bag: Bag, topics: dict[int, Topic], options: argparse.Namespace, stopped: list[int]
) -> int:
    patience_s = WAIT_FOR_INPUTS_S if options.inputs else WAIT_S
    player.wait(patience_s if options.wait is None else options.wait, for_solver=bool(options.inputs))
    begin, status = time.monotonic(), PLAYED
    while not stopped:
        before = player.count
        player.start_round()
        try:
            for topic, log_ns, data in bag.played(topics):
                player.play(topic, log_ns, data)
                if stopped:
                    break
        except BagError as error:
            _say(str(error))
            status = CUT_SHORT
        finally:
            player.end_round()
        if not options.loop or status or player.count == before:
            break
    broken = f", {player.broken} broken ones left out" if player.broken else ""
    _say(
        f"{player.count} messages in {time.monotonic() - begin:.1f} s{broken}: {player.frames} frames, "
        f"{player.answers} answers, {player.fixes} fixes"
    )
    if stopped:
        return status
    unanswered = player.frames > 0 and not player.answers
    return CUT_SHORT if unanswered or player.lost or not player.count else status

# SPDX-License-Identifier: Apache-2.0
"""`ros2 run starpos_bringup replay BAG`: play a rosbag2 into the running graph, byte for byte, with its time on /clock.

For machines without `ros2 bag play`, and to play as fast as the solver answers with the same result, which `ros2 bag
play` cannot.
"""

import argparse
import math
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

from starpos.errors import BagError, FrameError, StarposError
from starpos.recording.topics import DRIVER_INPUTS, RAW, Remaps
from starpos_bringup.bag import Bag, Topic
from starpos_common.node_main import own_arguments, stop_signals

if TYPE_CHECKING:
    from starpos_bringup.player import Player

# Exit statuses.
PLAYED, CUT_SHORT, REFUSED = 0, 1, 2
# The topic that must be there, and others.
INPUTS = {
    "stars": ("stars", ("camera/camera_info", "tilt", "gnss/fix")),
    "images": (RAW, ("camera/camera_info", "camera/capture", "tilt", "gnss/fix")),
}
WAIT_S, WAIT_FOR_INPUTS_S = 3.0, 30.0


def replay() -> int:
    """Run the executable."""
    with stop_signals() as stopped:
        return main(sys.argv[1:], stopped)


def main(arguments: list[str], stopped: list[int]) -> int:
    """Play to the end, or until a signal handler puts something into `stopped`; return the exit status."""
    ours, ros = own_arguments(arguments)
    options = _parser().parse_args(ours)
    try:
        with Bag(options.bag) as bag:
            remaps = Remaps.of(options.remap)
            if remaps.topics and options.inputs != "images":
                raise FrameError("--remap names a bag's images and accelerations: give --inputs images")
            wanted = bag.inputs(*INPUTS[options.inputs], remaps) if options.inputs else options.topics
            if options.inputs:
                _say(f"playing {', '.join(wanted)}")
            topics = bag.topics(wanted, left_out=_say)
            return 0 if stopped else _play(bag, topics, options, ros, stopped)
    except StarposError as error:
        _say(str(error))
        return REFUSED


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="replay",
        description="Play a rosbag2 into the running graph, with /clock from the time it was recorded at: start the "
        "nodes with -p use_sim_time:=true.",
        epilog="Exit status: 0 played, 1 cut short, or frames of which none was answered, 2 a bad call or a bag that "
        "cannot be read.",
    )
    parser.add_argument("bag", type=Path, metavar="BAG", help="its folder, or one .mcap or .db3 file")
    parser.add_argument(
        "--rate",
        type=_rate,
        default=1.0,
        metavar="R",
        help="times real time (1), or as fast as it is solved where that is slower; 0: as fast as it is solved. The "
        "fixes are the same at any rate",
    )
    some = parser.add_mutually_exclusive_group()
    some.add_argument("--topics", nargs="+", metavar="TOPIC", help="only these (all)")
    some.add_argument(
        "--inputs",
        choices=tuple(INPUTS),
        help="only the inputs of the solver (stars), or of detector, solver and, where no tilts are, "
        "inclinometer (images), in any namespace or from a robot's own drivers; their recorded outputs "
        "are left out",
    )
    parser.add_argument(
        "--remap",
        action="append",
        default=[],
        metavar="NAME:=TOPIC",
        help=f"with --inputs images: the bag's topic to use as one of {', '.join(DRIVER_INPUTS)}; without "
        f"it the "
        "one with this name, or the only one of its type. It is played under its own name: remap the nodes, or the "
        "player (--ros-args -r)",
    )
    parser.add_argument(
        "--loop", action="store_true", help="play again and again; the time begins anew as well"
    )
    parser.add_argument(
        "--wait",
        type=_rate,
        metavar="S",
        help="longest wait for subscribers (3; with --inputs 30, for the solver too)",
    )
    return parser


def _rate(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
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

    from starpos_bringup.player import Player

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
        player = Player(topics.values(), options.rate, stopped, contexts, _say)
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
    player.wait(patience_s if options.wait is None else options.wait, for_solver=bool(options.inputs))
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
        finally:
            player.end_round()
        if not options.loop or status or player.count == before:
            break
    broken = f", {player.broken} broken ones left out" if player.broken else ""
    answers, fixes = player.answers
    _say(
        f"{player.count} messages in {time.monotonic() - begin:.1f} s{broken}: {player.frames} frames, "
        f"{answers} answers, {fixes} fixes"
    )
    if stopped:
        return status
    unanswered = player.frames > 0 and not answers
    return CUT_SHORT if unanswered or player.lost or not player.count else status

# SPDX-License-Identifier: Apache-2.0
"""`starpos replay`: solve recorded nights with the code of the node `solver`, without ROS."""

import argparse

from starpos.cli import console, fix_output, inputs
from starpos.earth.vertical import Vertical
from starpos.errors import FrameError
from starpos.recording.drivers import Drivers
from starpos.recording.topics import remaps_of
from starpos.session.replay import PlayedNight, Playing
from starpos.session.settings import Settings
from starpos.units import utc_text


def run(args: argparse.Namespace) -> int:
    settings = Settings.of(args.params_file, args.param, args.namespace)
    output = console.Output(args, "fix")
    # a wrong parameter is reported once, not for each bag
    Drivers.of(args.params_file, args.param, args.namespace)
    work = Playing(args.params_file, tuple(args.param), args.namespace, remaps_of(args.remap))
    nights = inputs.worked(args, work, args.bags, "bag")
    return max(tell(args, output, bag, night, settings.vertical) for bag, night in nights)


def tell(
    args: argparse.Namespace,
    output: console.Output,
    bag: str,
    night: PlayedNight | FrameError,
    vertical: Vertical,
) -> int:
    """Write the solutions of a bag and the average of its place; returns the exit status."""
    if isinstance(night, FrameError):
        console.complain(night)
        return console.UNREADABLE
    console.complain_of(bag, *night.said)
    for solution in night.solutions:
        if not solution.fix:
            console.complain(f"{bag}: {solution.message}")
        time = "a frame" if solution.utc_unix_s is None else utc_text(solution.utc_unix_s)
        output.put(
            {"file": bag} | fix_output.json_of(solution.fix, vertical) | fix_output.json_about(solution),
            fix_output.line_of(f"{bag} {time}", solution, turning=False),
        )
    whole = night.together
    console.complain_of(bag, *whole.remarks)
    if whole.gathered.solved:
        fix_output.put_combined(output, bag if len(args.bags) > 1 else None, whole, vertical)
    if (by_satellites := night.by_satellites) is not None:
        from starpos.cli.satellites import fix_json

        value = {"file": bag, "by_satellites": True} | fix_json(by_satellites)
        output.put(value, f"by satellites: {by_satellites.text}", rows=())
    # a trouble names its bag
    console.complain(night.trouble or f"{bag}: {night.summary}")
    return console.UNREADABLE if night.trouble else 0 if whole.gathered.solved else console.NOTHING

# SPDX-License-Identifier: Apache-2.0
"""Replay of a recorded night through the solver, with its own time on /clock; everything ends with the bag.

    ros2 launch starpos_bringup replay.launch.py bag:=night rate:=0 params_file:=robot.yaml

If a bag holds images and no stars, detector:=true finds the stars again.
"""

from pathlib import Path

from launch.actions import Shutdown

from starpos_bringup import launching
from starpos_bringup.launch_arguments import LaunchError, is_true, number

MAX_RATE = 1e6
SIMULATED = {"**": {"use_sim_time": True}}


def over(event, context):
    """End everything with the bag; a replay that failed makes launch's exit status 1."""
    if event.returncode:
        raise LaunchError(f"the replay ended with exit status {event.returncode}: it says why above")
    return Shutdown(reason="the bag is played")


def nodes(told):
    rate = number(told, "rate", 0, MAX_RATE)
    bag = Path(told["bag"]).expanduser()
    if not bag.exists():
        raise LaunchError(f"bag:={bag}: there is no such bag")
    processes = [launching.process("starpos_solver", "solver", told, SIMULATED)]
    inputs = "stars"
    if is_true(told, "detector"):
        processes.append(launching.process("starpos_camera", "detector", told, SIMULATED))
        inputs = "images"
    player = ["--rate", f"{rate:g}", "--inputs", inputs, "--", str(bag)]
    return [
        *processes,
        *launching.dashboard(told, SIMULATED),
        launching.process("starpos_bringup", "replay", told, arguments=player, on_exit=over),
    ]


def generate_launch_description():
    return launching.described("replay", nodes)

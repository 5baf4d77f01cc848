# SPDX-License-Identifier: Apache-2.0
"""The instrument on two hosts under a simulated sky, and the traffic on the cable between them."""

from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from starpos.simulation.scene import scene_of
from starpos_testing.graph.hosts import Cable, Ear, Host
from starpos_testing.graph.shots import FULL, focal_of
from starpos_testing.patience import WAIT_S

FULL_FRAME_BYTES = FULL[0] * FULL[1] * 2
PIXEL_UM = 6.4
# Errors of the inclinometer as it comes.
TILT_RATE_HZ = 10


@dataclass(frozen=True)
class LinkedInstrument:
    """Two hosts, their cable, and an ear next to the solver."""

    mount: Host
    robot: Host
    cable: Cable
    ear: Ear

    def wait(self, condition, **patience) -> None:
        """Wait until a condition of what the ear hears is true; raises AssertionError with the output of the programs."""
        self.ear.wait(condition, self.mount, self.robot, **patience)


@contextmanager
def two_hosts(**environment):
    """Make an instrument whose programs do not run yet; `environment` is set on both hosts."""
    with (
        Host("mount", **environment) as mount,
        Host("robot", **environment) as robot,
        Cable(mount, robot) as cable,
        Ear(robot) as ear,
    ):
        yield LinkedInstrument(mount, robot, cable, ear)


def start(
    instrument: LinkedInstrument, folder: Path, size: tuple[int, int], cadence_s: float, *patience: str
):
    """Start camera and detector (one process) and inclinometer on the mount, the solver on the robot; returns the camera.

    patience: more parameters of the solver.
    """
    mount, robot = instrument.mount, instrument.robot
    focal_px, port = focal_of(size), folder / "port"
    tilt_x, tilt_y = np.degrees(scene_of(size, focal_px).tilt)
    tilts = ("--link", str(port), f"--tilt-x={tilt_x:.9f}", f"--tilt-y={tilt_y:.9f}", "--seed", "11")
    robot.start(folder / "solver.log", "starpos_solver", "solver", "misalignment_stddev:=5.0", *patience)
    mount.start(folder / "emulator.log", "starpos_testing", "emulator", arguments=tilts)
    mount.start(
        folder / "inclinometer.log",
        "starpos_inclinometer",
        "inclinometer",
        f"port:={port}",
        f"rate:={TILT_RATE_HZ}",
    )
    return mount.start(
        folder / "camera.log",
        "starpos_camera",
        "camera_detector",
        "source:=simulated",
        f"cadence:={cadence_s}",
        "exposure:=0.5",
        f"focal_mm:={focal_px * PIXEL_UM * 1e-3}",
        f"pixel_um:={PIXEL_UM}",
        f"simulated.width:={size[0]}",
        f"simulated.height:={size[1]}",
    )


@dataclass(frozen=True)
class Traffic:
    """Bytes that went over the cable both ways, with all headers and the traffic of DDS; stars: mean of a frame."""

    frames: int
    stars: float
    # Above what flows without a camera.
    bytes_per_frame: float
    # How much of that is tilts.
    bytes_per_second: float


def traffic(folder: Path, frames: int, cadence_s: float, quiet_s: float = 10.0, size=FULL) -> Traffic:
    """Measure the traffic of a number of frames; the first, during which nodes find each other, do not count.

    quiet_s: time without a camera, to measure the tilts' traffic.
    """
    with two_hosts() as instrument:
        camera = start(instrument, folder, size, cadence_s)
        ear, cable = instrument.ear, instrument.cable

        def after(count: int) -> tuple[int, float]:
            instrument.wait(lambda: len(ear.fixed) >= count, seconds=WAIT_S + count * cadence_s)
            return cable.bytes, max(ear.at_s.values())

        (begin, begin_s), first = after(2), len(ear.solutions)
        end, end_s = after(2 + frames)
        counted = len(ear.solutions) - first
        camera.end()
        quiet = cable.bytes
        ear.comes(lambda: False, quiet_s)
        each_second = (cable.bytes - quiet) / quiet_s
        each_frame = (end - begin - each_second * (end_s - begin_s)) / counted
        stars = np.mean([s.stars_detected for s in ear.solutions.values()])
    return Traffic(counted, float(stars), each_frame, each_second)

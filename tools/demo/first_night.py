# SPDX-License-Identifier: Apache-2.0
"""A first night on an emulated instrument: somebody does what `starpos first-night` says, until A3 is saved.

The nodes are the installed ones: `inclinometer` on the firmware of an emulated board, `camera` with a simulated sky,
`detector`, and `folder`, from which `starpos first-night` reads.  The simulated lens is in focus from the begin.  Prints
the transcript.  Exit status 0 if A3 is saved, within 4 sigma of the truth; 2 where something is not installed.
"""

import argparse
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from emulated_instrument import NEEDED, lacking, start_board
from instrument_run import Processes

from starpos_testing.domain import own_domain
from starpos_testing.skies.first_night import A3_DEG, Stand, scene_at

LATITUDE_DEG, LONGITUDE_DEG = 47.3, 8.5
SIZE, FOCAL_PX, BINNED_UM = (2808, 1872), 46875.0, 12.8
CADENCE_S, EXPOSURE_S = 2.0, 0.5
# Whoever moves the instrument takes so long.
MOVING_S = 4.0
ACCEPTED_SIGMA = 4.0


class Person:
    """Moves camera and level together, as the words after an arrow say."""

    def __init__(self, board, scene):
        import rclpy
        from rclpy.parameter_client import AsyncParameterClient

        rclpy.init()
        self.rclpy, self.node = rclpy, rclpy.create_node("person")
        self.board, self.scene, self.stand = board, scene, Stand(1)
        self.camera = AsyncParameterClient(self.node, "camera")

    def does(self, found: str, todo: str):
        """Do what is said, if it has not been done yet."""
        stand = self.stand
        if todo.startswith("raise one foot"):
            stand = Stand(1, lean_deg=(2.0, 0.0))
        elif todo.startswith("raise only another foot"):
            stand = Stand(1, lean_deg=(0.0, 2.0))
        elif todo.startswith("set the foot back"):
            stand = Stand(1)
        elif todo.startswith("turn by 90 deg"):
            # "heading 2 of 4: frame 3"
            stand = Stand(1, turn_deg=90.0 * int(found.split()[1]))
        if stand != self.stand:
            self.moves(stand)

    def moves(self, stand: Stand):
        from rclpy.parameter import Parameter

        begin, end = (np.degrees(scene_at(s, self.scene).tilt) for s in (self.stand, stand))
        self.tilt(*begin, *((end - begin) / MOVING_S))
        time.sleep(MOVING_S / 2)
        at = scene_at(stand, self.scene)
        angles = {"azimuth": at.azimuth_deg, "altitude": at.altitude_deg, "roll": at.roll_deg}
        self.camera.wait_for_services(10.0)
        values = [Parameter(f"simulated.{name}", value=float(angle)) for name, angle in angles.items()]
        self.rclpy.spin_until_future_complete(self.node, self.camera.set_parameters(values), timeout_sec=10.0)
        time.sleep(MOVING_S / 2)
        self.tilt(*end)
        self.stand = stand

    def tilt(self, *numbers: float):
        self.board.stdin.write(f"tilt {' '.join(f'{n:.6f}' for n in numbers)}\n".encode())
        self.board.stdin.flush()

    def close(self):
        self.node.destroy_node()
        self.rclpy.try_shutdown()


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--out", type=Path, default=Path("demo/first_night"), help="folder of night, instrument and logs"
    )
    out = parser.parse_args().out
    if lack := lacking(NEEDED - {"indi-bin"}):
        print(f"first_night: not all that it needs is here; type: {lack}", file=sys.stderr)
        return 2
    with own_domain(), tempfile.TemporaryDirectory() as scratch:
        return run(out, Path(scratch))


def run(out: Path, scratch: Path) -> int:
    """Run it; return the exit status."""
    from starpos.simulation.scene import scene_of

    night, saved = out / "night", out / "instrument.yaml"
    night.mkdir(parents=True)
    scene = scene_of(
        size=SIZE,
        focal_px=FOCAL_PX,
        latitude_deg=LATITUDE_DEG,
        longitude_deg=LONGITUDE_DEG,
        misalignment_deg=A3_DEG,
    )
    processes = Processes(scratch)
    try:
        board, link = start_board(processes, np.degrees(scene.tilt))
        person = Person(board, scene)
        processes.node("starpos_inclinometer", "inclinometer", {"port": link})
        sky = {"simulated.width": SIZE[0], "simulated.height": SIZE[1], "pixel_um": BINNED_UM}
        sky |= {"simulated.latitude": LATITUDE_DEG, "simulated.longitude": LONGITUDE_DEG}
        camera = {"source": "simulated", "cadence": CADENCE_S, "exposure": EXPOSURE_S}
        processes.node("starpos_camera", "detector", {})
        processes.node("starpos_camera", "camera", camera | sky)
        processes.start("folder", ["ros2", "run", "starpos_bringup", "folder", str(night)])
        command = [
            "starpos",
            "first-night",
            night.name,
            "--inclinometer",
            "sca100t_calibrated",
            "--save",
            saved.name,
            "--patience",
            "60",
        ]
        begin = time.monotonic()
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=out) as told:
            found = ""
            for line in told.stdout:
                print(line, end="", flush=True)
                text = line[22:].strip() if "->" not in line else line.partition("->")[2].strip()
                if "->" in line:
                    person.does(found, text)
                else:
                    found = text
        person.close()
    finally:
        processes.stop()
    print(f"({time.monotonic() - begin:.0f} s)")
    return told.returncode or judged(saved)


def judged(saved: Path) -> int:
    """Exit status by how far the saved A3 is from the truth."""
    from starpos.instrument import instrument_file

    calibration = instrument_file.read(saved, needs_camera=False).calibration
    off = 3600 * np.subtract(calibration.misalignment_deg, A3_DEG)
    sigma = np.sqrt(np.diag(calibration.covariance_arcsec2))
    print(
        f"A3 is off by {', '.join(f'{o:.0f}' for o in off)} arcsec, claimed {', '.join(f'{s:.0f}' for s in sigma)}"
    )
    return 0 if (np.abs(off) < ACCEPTED_SIGMA * sigma).all() else 1


if __name__ == "__main__":
    sys.exit(main())

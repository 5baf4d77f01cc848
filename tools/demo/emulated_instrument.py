# SPDX-License-Identifier: Apache-2.0
"""The whole instrument with emulated devices: firmware, hot shoe, GNSS pulses, INDI camera, detector, solver.

The inclinometer's firmware, as it is flashed, runs on an emulated ATmega8 with its converter and sensor
(starpos_inclinometer/test/sim). The camera is the CCD simulator of a real indiserver; indi_sky.py gives it the sky of
each exposure, and a shutter that opens 0.3 s after the command: its contact and a receiver's pulse per second go to the
board. The four nodes are the installed ones. The place is drawn at random, and the nodes know neither it nor the lag:
the frames with a time of their shutter (the sixth and later ones) make the place, and it goes on until there is one.
The same frames are solved once more with the true times.  Exit status 0 if the truth lies within 4 sigma, both places
are within 10 m, the camera node has measured the lag within 10 ms, and all ended cleanly; 2 where something is not
installed.
"""

import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
from indi_sky import DEVICE, PIXEL_UM
from instrument_run import (
    Place,
    Processes,
    Watcher,
    error_m,
    introduce,
    known_of,
    parse,
    parser_of,
    say_errors,
    stamp_of,
    summarise,
    trouble_of,
)

from starpos_testing.domain import own_domain

FRAMES, CADENCE_S, EXPOSURE_S = 20, 1.5, 0.5
# Frames of a quarter of the pixels take a quarter of the time.
BINNING = 2
START_S = 5.0
EXACT_ARCSEC, EXACT_S = 0.1, 0.001
# Capture.HARDWARE
HARDWARE = 4
# Of the emulated camera, from the command to the open shutter.
LAG_S, LAG_STDDEV_S = 0.3, 0.004
# How far the measured lag, and a place by pulses from that by known times, may be off.
LAG_OFF_S, PLACE_OFF_M = 0.01, 10.0
# It waits for a frame with the time of its shutter up to this many times the frames that are asked for.
MAX_RUNS = 5
ROOT = Path(__file__).resolve().parents[2]
NEEDED = {"gcc-avr", "avr-libc", "libsimavr-dev", "libelf-dev", "indi-bin"}


def lacking(needed: set[str] = NEEDED) -> str | None:
    """Say in a command how to install all that the devices need and this machine lacks; None if it has all."""
    missing = subprocess.run(
        [ROOT / "tools" / "setup" / "missing", "tests"], capture_output=True, text=True, check=True
    )
    packages = sorted(needed & set(missing.stdout.split()))
    return f"sudo apt-get install {' '.join(packages)}" if packages else None


def start_board(devices: Processes, tilt_deg: np.ndarray) -> tuple[subprocess.Popen, str]:
    """Start the paper's board at a tilt; returns its process, which takes commands, and its serial port."""
    folder = devices.folder
    make = ["make", "-C", str(ROOT / "starpos_inclinometer" / "firmware"), f"BUILD={folder}", "all", "sim"]
    subprocess.run(make, check=True, stdout=subprocess.DEVNULL)
    board, link = [str(folder / "inclinometer-sim"), str(folder / "paper.elf")], str(folder / "port")
    tilt = ["--tilt", *(f"{angle:.9f}" for angle in tilt_deg)]
    # It ends when its input ends.
    return devices.start("board", [*board, "--link", link, *tilt], stdin=subprocess.PIPE), link


def start_devices(devices: Processes, place: Place, seed: int) -> dict[str, dict]:
    """Start inclinometer, camera and sky; return for each node the parameters by which it finds its device."""
    folder = devices.folder
    board, link = start_board(devices, np.degrees(place.scene().tilt))
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = str(probe.getsockname()[1])
    server = ["indiserver", "-p", port, "-u", str(folder / "indi"), "indi_simulator_ccd"]
    # The drivers keep their settings in HOME.
    devices.start("indiserver", server, env=os.environ | {"HOME": str(folder)})
    wait_for(int(port))
    sky = [
        sys.executable,
        str(ROOT / "tools" / "demo" / "indi_sky.py"),
        port,
        str(folder),
        str(EXPOSURE_S),
        str(seed),
    ]
    sky += [json.dumps(asdict(place)), str(LAG_S), str(LAG_STDDEV_S)]
    sky = devices.start("sky", sky, stdout=board.stdin, stderr=subprocess.PIPE, text=True)
    if (said := sky.stderr.readline()) != "ready\n":
        raise RuntimeError(f"the sky does not come up: {said}{sky.stderr.read()}")
    board.stdin.write(f"pps {1e3 * (1 - time.time() % 1):.3f} 1000\n".encode())
    board.stdin.flush()
    # The lag is not stated, only that there may be one as long.
    lag = {"driver_lag_stddev": LAG_S, "pulses": True, "pulses.curtain_stddev": EXACT_S}
    camera = {
        "source": "indi",
        "indi.port": port,
        "indi.device": DEVICE,
        "pixel_um": PIXEL_UM * BINNING,
    } | lag
    return {"inclinometer": {"port": link}, "camera": camera}


def wait_for(port: int):
    """Wait until somebody listens there; OSError after some seconds."""
    end = time.monotonic() + START_S
    while True:
        try:
            socket.create_connection(("127.0.0.1", port)).close()
            return
        except ConnectionRefusedError:
            if time.monotonic() > end:
                raise
            time.sleep(0.02)


def known_by(place: Place) -> dict:
    """Parameters of the solver."""
    # A3 is exact here, and the sky has the same clock, so their usual errors would only widen the covariance.
    exact = {"misalignment_stddev": EXACT_ARCSEC, "inclinometer.model": "sca100t_calibrated"}
    return known_of(place) | exact


def start_nodes(nodes: Processes, place: Place, found: dict):
    nodes.node("starpos_inclinometer", "inclinometer", found["inclinometer"])
    nodes.node("starpos_solver", "solver", known_by(place))
    nodes.node("starpos_camera", "detector", {})
    nodes.node("starpos_camera", "camera", found["camera"] | {"cadence": CADENCE_S, "exposure": EXPOSURE_S})


class Recorder:
    """Listens, on the watcher's node, to the solver's inputs and to the lag that the camera reports."""

    def __init__(self, watcher: Watcher):
        from diagnostic_msgs.msg import DiagnosticArray
        from sensor_msgs.msg import CameraInfo

        from starpos_interfaces.msg import StarArray, Tilt

        self.stars, self.tilts, self.infos, self.lag = {}, [], [], ""
        listen = watcher.node.create_subscription
        listen(StarArray, "stars", lambda m: self.stars.setdefault(stamp_of(m), m), 10)
        listen(Tilt, "tilt", self.tilts.append, 100)
        listen(CameraInfo, "camera/camera_info", self.infos.append, 10)
        listen(DiagnosticArray, "/diagnostics", self._on_diagnostics, 10)

    def _on_diagnostics(self, message):
        values = {v.key: v.value for s in message.status if s.name == "camera: Capture" for v in s.values}
        self.lag = values.get("measured lag", self.lag)

    def solved(self, stamp: tuple[int, int], mid_s: float, place: Place):
        """The fix of a frame whose middle of the exposure is known."""
        from starpos.messages.camera import message_to_camera
        from starpos.messages.stars import message_to_stars
        from starpos.session.settings import Settings
        from starpos.session.tilts import TiltBuffer
        from starpos.sky.catalogue import load_catalogue

        settings = Settings.of(None, [f"{name}:={value}" for name, value in known_by(place).items()])
        solver = settings.solver(message_to_camera(self.infos[-1]), None, load_catalogue())
        tilts = TiltBuffer(settings)
        for tilt in self.tilts:
            tilts.keep(tilt)
        stars = replace(message_to_stars(self.stars[stamp]), mid_unix_s=mid_s)
        return solver.solve(stars, tilts).fix


def times_off(watcher: Watcher, solutions: list, begun_s: list[float]) -> np.ndarray:
    """How late the stamp of each solution's frame is, in s, after the true middle of its exposure."""
    mids = np.array([mid_of(s) for s in solutions])
    away = mids[:, None] - (np.array(begun_s) + EXPOSURE_S / 2)
    return away[np.arange(len(mids)), np.abs(away).argmin(1)]


def mid_of(message) -> float:
    return message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec


def by_known_times(recorder: Recorder, solutions: list, off_s: np.ndarray, place: Place) -> np.ndarray:
    """How far (m east, north) the mean place of frames is from theirs with known times.

    A busy machine may lose the stars of a frame on their way to the recorder: such a frame is in neither mean.
    """
    heard = [(s, late_s) for s, late_s in zip(solutions, off_s, strict=True) if stamp_of(s) in recorder.stars]
    errors = []
    for solution, late_s in heard:
        fix = recorder.solved(stamp_of(solution), mid_of(solution) - late_s, place)
        errors.append(error_m(np.degrees(fix.latitude), np.degrees(fix.longitude), place))
    return np.mean([error_m(s.latitude, s.longitude, place) for s, _ in heard], 0) - np.mean(errors, 0)


def main() -> int:
    args = parse(parser_of(__doc__, FRAMES, "demo/emulated"))
    if lack := lacking():
        print(f"emulated_instrument: not all that it needs is here; type: {lack}", file=sys.stderr)
        return 2
    with own_domain():
        return run(args.seed, args.frames, args.out)


def run(seed: int, frames: int, out: Path) -> int:
    """Run it; return the exit status."""
    out.mkdir(parents=True, exist_ok=True)
    place = replace(Place.drawn(np.random.default_rng(seed)), binning=BINNING)
    introduce(
        seed,
        place,
        f"four nodes, the firmware on an emulated MCU, the CCD simulator of indiserver with a lag of {LAG_S} s",
    )
    # The link to a pty needs a short path.
    with tempfile.TemporaryDirectory() as scratch:
        devices, nodes = Processes(Path(scratch)), Processes(Path(scratch))
        watcher = Watcher(place)
        recorder = Recorder(watcher)
        begun, memory = "", {}
        try:
            found = start_devices(devices, place, seed)
            start_nodes(nodes, place, found)
            trouble = watcher.watch(frames, nodes, devices)
            # a busy machine may lose a pulse, and hear a Capture late
            while not trouble and not timed_by_pulses(watcher):
                trouble = watcher.watch(len(watcher.solutions) + 1, nodes, devices)
                if len(watcher.solutions) > MAX_RUNS * frames:
                    trouble = "no frame has a time of its shutter"
            memory = {} if trouble else nodes.peak_mb()
        except KeyboardInterrupt:
            trouble = "interrupted"
        except (OSError, RuntimeError, subprocess.CalledProcessError) as error:
            trouble = str(error)
        codes = nodes.stop() | devices.stop()
        # A signal is its only way to end.
        if codes.get("indiserver") == -signal.SIGINT:
            codes["indiserver"] = 0
        if "sky" in devices.running:
            begun = devices.running["sky"].stderr.read()
        for log in Path(scratch).glob("*.log"):
            shutil.copy(log, out)
    watcher.close()
    return conclude(watcher, recorder, trouble_of(watcher, codes, trouble), begun, memory, out)


def timed_by_pulses(watcher: Watcher) -> list:
    """The fixes of frames that have the time of their shutter; a busy machine may lose a Capture."""
    heard = [s for s in watcher.good() if stamp_of(s) in watcher.captures]
    return [s for s in heard if watcher.captures[stamp_of(s)].stamp_source == HARDWARE]


def conclude(
    watcher: Watcher, recorder: Recorder, trouble: str | None, begun: str, memory: dict, out: Path
) -> int:
    if trouble:
        print(f"\nemulated_instrument: {trouble}; the logs are in {out}", file=sys.stderr)
        return 1
    timed = timed_by_pulses(watcher)
    summary, *_ = summarise(timed, watcher.place)
    inside = say_errors(watcher, summary)
    off_s = times_off(watcher, timed, [float(s) for s in begun.split()])
    moved = by_known_times(recorder, timed, off_s, watcher.place)
    lag_s = float(recorder.lag.split()[0])
    summary |= {
        "solved": len(watcher.solutions),
        "times_off_ms": (1e3 * off_s).tolist(),
        "east_of_known_times_m": moved[0],
        "north_of_known_times_m": moved[1],
        "lag_s": lag_s,
        "peak_memory_mb": memory,
    }
    (out / "summary.json").write_text(json.dumps(summary, indent=1) + "\n")
    print(
        f"{len(timed)} frames have the time of their shutter, off by {1e3 * np.median(np.abs(off_s)):.2f} ms (median; at "
        f"most {1e3 * np.abs(off_s).max():.2f}): {np.hypot(*moved):.2f} m from where known times put them. "
        f"Lag: {LAG_S} s, measured {recorder.lag}"
    )
    print("peak memory " + ", ".join(f"{name} {mb} MB" for name, mb in memory.items()))
    near = np.hypot(*moved) < PLACE_OFF_M and abs(lag_s - LAG_S) < LAG_OFF_S
    return 0 if inside and near else 1


if __name__ == "__main__":
    sys.exit(main())

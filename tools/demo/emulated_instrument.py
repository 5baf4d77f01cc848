# SPDX-License-Identifier: Apache-2.0
"""The whole instrument with emulated devices: firmware, INDI camera, detector, solver.

The inclinometer's firmware, as it is flashed, runs on an emulated ATmega8 with its converter and sensor
(starpos_inclinometer/test/sim). The camera is the CCD simulator of a real indiserver; indi_sky.py gives it the sky of
each exposure, and a shutter that opens 0.3 s after the command; the camera node has this lag as a parameter. The four
nodes are the installed ones. The place is drawn at random, and the nodes do not know it. Exit status 0 if the truth lies
within 4 sigma and all ended cleanly; 2 where something is not installed.
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
    introduce,
    known_of,
    parse,
    parser_of,
    say_errors,
    summarise,
    trouble_of,
)

from starpos_testing.domain import own_domain

FRAMES, CADENCE_S, EXPOSURE_S = 20, 1.5, 0.5
# Frames of a quarter of the pixels take a quarter of the time.
BINNING = 2
START_S = 5.0
EXACT_ARCSEC = 0.1
# Of the emulated camera, from the command to the open shutter.
LAG_S, LAG_STDDEV_S = 0.3, 0.004
# Its stated error: the sky of a busy machine comes late too.
LAG_STATED_STDDEV_S = 0.02
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
    _, link = start_board(devices, np.degrees(place.scene().tilt))
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
    sky = devices.start("sky", sky, stderr=subprocess.PIPE, text=True)
    if (said := sky.stderr.readline()) != "ready\n":
        raise RuntimeError(f"the sky does not come up: {said}{sky.stderr.read()}")
    camera = {
        "source": "indi",
        "indi.port": port,
        "indi.device": DEVICE,
        "pixel_um": PIXEL_UM * BINNING,
        "driver_lag": LAG_S,
        "driver_lag_stddev": LAG_STATED_STDDEV_S,
    }
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


def times_off(solutions: list, begun_s: list[float]) -> np.ndarray:
    """How late the stamp of each solution's frame is, in s, after the true middle of its exposure."""
    mids = np.array([mid_of(s) for s in solutions])
    away = mids[:, None] - (np.array(begun_s) + EXPOSURE_S / 2)
    return away[np.arange(len(mids)), np.abs(away).argmin(1)]


def mid_of(message) -> float:
    return message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec


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
        begun, memory = "", {}
        try:
            found = start_devices(devices, place, seed)
            start_nodes(nodes, place, found)
            trouble = watcher.watch(frames, nodes, devices)
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
    return conclude(watcher, trouble_of(watcher, codes, trouble), begun, memory, out)


def conclude(watcher: Watcher, trouble: str | None, begun: str, memory: dict, out: Path) -> int:
    good = watcher.good()
    if not trouble and not good:
        trouble = "no frame has a place"
    if trouble:
        print(f"\nemulated_instrument: {trouble}; the logs are in {out}", file=sys.stderr)
        return 1
    summary, *_ = summarise(good, watcher.place)
    inside = say_errors(watcher, summary)
    off_s = times_off(good, [float(s) for s in begun.split()])
    summary |= {
        "solved": len(watcher.solutions),
        "times_off_ms": (1e3 * off_s).tolist(),
        "peak_memory_mb": memory,
    }
    (out / "summary.json").write_text(json.dumps(summary, indent=1) + "\n")
    print(
        f"the stamps of {len(good)} frames are off by {1e3 * np.median(np.abs(off_s)):.2f} ms (median; at most "
        f"{1e3 * np.abs(off_s).max():.2f})"
    )
    print("peak memory " + ", ".join(f"{name} {mb} MB" for name, mb in memory.items()))
    return 0 if inside else 1


if __name__ == "__main__":
    sys.exit(main())

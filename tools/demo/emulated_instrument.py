# SPDX-License-Identifier: Apache-2.0
"""The whole instrument with emulated devices: firmware, INDI camera, detector, solver.

The inclinometer's firmware, as it is flashed, runs on an emulated ATmega8 with its converter and sensor
(starpos_inclinometer/firmware/sim). The camera is the CCD simulator of a real indiserver; indi_sky.py gives it the sky of
each exposure. The four nodes are the installed ones. The place is drawn at random, and the nodes are not told it.  Exit
status 0 if the truth lies within 4 sigma and all ended cleanly; 2 where something is not installed.
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
from dataclasses import asdict
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from indi_sky import DEVICE
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

FRAMES, CADENCE_S, EXPOSURE_S = 10, 3.0, 0.5
START_S = 5.0
EXACT_ARCSEC, EXACT_S = 0.1, 0.001
# The sky may lag behind the frames' stamps by the error that the source states.
LATE_MS = 5.0
ROOT = Path(__file__).resolve().parents[2]
NEEDED = {"gcc-avr", "avr-libc", "libsimavr-dev", "libelf-dev", "indi-bin"}


def lacking() -> str | None:
    """Say in commands how to install all that the devices need and this machine lacks; None if it has all."""
    missing = subprocess.run(
        [ROOT / "tools" / "setup" / "missing", "tests"], capture_output=True, text=True, check=True
    )
    commands = []
    if packages := sorted(NEEDED & set(missing.stdout.split())):
        commands.append(f"sudo apt-get install {' '.join(packages)}")
    if not find_spec("indipyclient"):
        commands.append("pip install indipyclient")
    return " && ".join(commands) or None


def start_devices(devices: Processes, place: Place, seed: int) -> dict[str, dict]:
    """Start inclinometer, camera and sky; return for each node the parameters by which it finds its device."""
    folder = devices.folder
    make = ["make", "-C", str(ROOT / "starpos_inclinometer" / "firmware"), f"BUILD={folder}", "all", "sim"]
    subprocess.run(make, check=True, stdout=subprocess.DEVNULL)
    board, link = [str(folder / "inclinometer-sim"), str(folder / "paper.elf")], str(folder / "port")
    theta_x, theta_y = np.degrees(place.scene().tilt)
    tilt = ["--tilt", f"{theta_x:.9f}", f"{theta_y:.9f}"]
    # It ends when its input ends.
    devices.start("board", [*board, "--link", link, *tilt], stdin=subprocess.PIPE)
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
    sky = devices.start("sky", [*sky, json.dumps(asdict(place))], stdout=subprocess.PIPE, text=True)
    if sky.stdout.readline() != "ready\n":
        raise RuntimeError(f"the sky does not come up: see {folder}/sky.log")
    camera = {"source": "indi", "indi.port": port, "indi.device": DEVICE, "driver_lag_stddev": LATE_MS / 1000}
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


def start_nodes(nodes: Processes, place: Place, found: dict):
    nodes.node("starpos_inclinometer", "inclinometer", found["inclinometer"])
    # A3 is exact here, and the clock is also that of the sky, so their usual errors would only widen the covariance.
    exact = {
        "misalignment_stddev": EXACT_ARCSEC,
        "inclinometer.model": "sca100t_calibrated",
        "clock_stddev": EXACT_S,
    }
    nodes.node("starpos_solver", "solver", known_of(place) | exact)
    nodes.node("starpos_camera", "detector", {})
    nodes.node("starpos_camera", "camera", found["camera"] | {"cadence": CADENCE_S, "exposure": EXPOSURE_S})


def latenesses_ms(watcher: Watcher, begun_s: list[float]) -> np.ndarray:
    """Delay of each frame's sky after the begin of the exposure that its stamp states."""
    starts = [s + 1e-9 * ns - watcher.captures[s, ns].exposure / 2 for s, ns in watcher.solutions]
    away = np.array(begun_s) - np.array(starts)[:, None]
    return 1e3 * away[np.arange(len(starts)), np.abs(away).argmin(1)]


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
    place = Place.drawn(np.random.default_rng(seed))
    introduce(
        seed,
        place,
        "four nodes, the firmware on an emulated MCU, the CCD simulator of indiserver under a sky",
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
            begun = devices.running["sky"].stdout.read()
        for log in Path(scratch).glob("*.log"):
            shutil.copy(log, out)
    watcher.close()
    return conclude(
        watcher, trouble_of(watcher, codes, trouble), [float(s) for s in begun.split()], memory, out
    )


def conclude(watcher: Watcher, trouble: str | None, begun_s: list[float], memory: dict, out: Path) -> int:
    if watcher.good():
        summary, *_ = summarise(watcher.good(), watcher.place)
        inside = say_errors(watcher, summary)
    if trouble:
        print(f"\nemulated_instrument: {trouble}; the logs are in {out}", file=sys.stderr)
        return 1
    late_ms = latenesses_ms(watcher, begun_s)
    summary |= {"sky_late_ms": late_ms.tolist(), "peak_memory_mb": memory}
    (out / "summary.json").write_text(json.dumps(summary, indent=1) + "\n")
    print(
        f"the frames showed the sky of {np.median(np.abs(late_ms)):.2f} ms (median; at most {np.abs(late_ms).max():.2f}) "
        "from the mid-exposure that they state; peak memory "
        + ", ".join(f"{name} {mb} MB" for name, mb in memory.items())
    )
    return 0 if inside and np.median(np.abs(late_ms)) < LATE_MS else 1


if __name__ == "__main__":
    sys.exit(main())

# SPDX-License-Identifier: Apache-2.0
"""The whole instrument under a simulated sky, live: the four installed nodes, an emulated inclinometer on a pty.

The place is drawn at random and not given to the solver.  Exit status 0 if the truth lies within 4 sigma and no
node took more memory than it may.  All of it runs in a ROS domain of its own: no other graph hears it.  The dashboard
shows it meanwhile, and with --stay goes on until Ctrl-C.
"""

import json
import math
import socket
import sys
import tempfile
from collections import deque
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from instrument_run import (
    Place,
    Processes,
    Watcher,
    executable,
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

FRAMES, CADENCE_S, EXPOSURE_S = 10, 3.0, 0.5
# Most memory of each node.
MEMORY_LIMIT_MB = 500
# Frames of 42 MB; a frame's solution comes before the third frame after it.
FRAMES_KEPT = 3


class PictureWatcher(Watcher):
    """Keeps one solved frame, `pictured`, and all stars."""

    def __init__(self, place: Place):
        super().__init__(place)
        from sensor_msgs.msg import Image

        from starpos_interfaces.msg import StarArray

        self.stars, self.frames, self.pictured = {}, deque(maxlen=FRAMES_KEPT), None
        self.node.create_subscription(StarArray, "stars", lambda m: self.stars.update({stamp_of(m): m}), 10)
        self.image = self.node.create_subscription(Image, "camera/image_raw", self._on_image, 1)

    def _on_image(self, message):
        self.frames.append(message)
        # One frame of 42 MB is enough.
        if self.pictured is not None and self.image is not None:
            self.node.destroy_subscription(self.image)
            self.image = None
            self.frames.clear()

    def _on_solution(self, message):
        super()._on_solution(message)
        if self.pictured is None and message.status == message.OK:
            self.pictured = next((f for f in self.frames if stamp_of(f) == stamp_of(message)), None)


def start(processes: Processes, place: Place, seed: int, port: Path):
    """Start the emulated inclinometer, with a link to it at `port`, and the nodes that make a fix."""
    theta_x, theta_y = np.degrees(place.scene().tilt)
    link = str(port)
    tilt = ["--tilt-x", f"{theta_x:.9f}", "--tilt-y", f"{theta_y:.9f}", "--seed", str(seed)]
    processes.start("emulator", [executable("starpos_testing", "emulator"), "--link", link, *tilt])
    processes.node("starpos_inclinometer", "inclinometer", {"port": link})
    processes.node("starpos_solver", "solver", known_of(place))
    processes.node("starpos_camera", "detector", {})
    names = ("latitude", "longitude", "azimuth", "altitude", "roll", "pressure", "temperature", "humidity")
    simulated = {f"simulated.{name}": getattr(place, name) for name in names}
    camera = {"source": "simulated", "cadence": CADENCE_S, "exposure": EXPOSURE_S, "simulated.seed": seed}
    processes.node("starpos_camera", "camera", camera | simulated)


def picture(watcher: PictureWatcher, errors: np.ndarray, covariance: np.ndarray, path: Path) -> bool:
    """Draw the fixes and the frame that was kept; return False without one, or if its stars were not heard."""
    from picture import draw

    from starpos.frames.annotate import Identified, annotate
    from starpos.messages.camera import message_to_frame
    from starpos.messages.stars import message_to_stars

    frame, place = watcher.pictured, watcher.place
    if frame is None or stamp_of(frame) not in watcher.stars:
        return False
    solution, stars = watcher.solutions[stamp_of(frame)], message_to_stars(watcher.stars[stamp_of(frame)])
    known = Identified(solution.indices, solution.ids, solution.magnitudes)
    shown = annotate(message_to_frame(frame), stars, known)
    title = f"simulated sky, {place.latitude:+.4f} {place.longitude:+.4f}: {len(errors)} frames of {EXPOSURE_S:g} s"
    about = f"a frame and its {len(solution.ids)} identified stars"
    draw(path, errors, covariance[:2, :2], title, shown, about)
    return True


def show(processes: Processes) -> str:
    """Start the dashboard; return its address, '' if tornado is not installed."""
    if not find_spec("tornado"):
        return ""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    processes.node("starpos_dashboard", "dashboard", {"port": port})
    return f"http://127.0.0.1:{port}"


def main() -> int:
    parser = parser_of(__doc__, FRAMES, "demo")
    parser.add_argument("--stay", action="store_true", help="go on after the last frame, for the dashboard")
    args = parse(parser)
    with own_domain():
        return run(args.seed, args.frames, args.out, args.stay)


def run(seed: int, frames: int, out: Path, stay: bool = False) -> int:
    """Run the demo; return its exit status."""
    out.mkdir(parents=True, exist_ok=True)
    place = Place.drawn(np.random.default_rng(seed))
    introduce(seed, place, "four nodes and an emulated inclinometer")
    # The link to a pty needs a short path.
    with tempfile.TemporaryDirectory() as scratch:
        processes = Processes(out)
        watcher = PictureWatcher(place)
        start(processes, place, seed, Path(scratch) / "inclinometer-port")
        if page := show(processes):
            print(f"to look at meanwhile: {page}", flush=True)
        else:
            print("no dashboard, which needs tornado: pip install tornado", flush=True)
        try:
            trouble = watcher.watch(frames, processes)
            memory = {} if trouble else processes.peak_mb()
            if stay and not trouble:
                trouble = look(watcher, processes, page)
        except KeyboardInterrupt:
            trouble, memory = "interrupted", {}
        codes = processes.stop()
    watcher.close()
    status = conclude(watcher, codes, memory, trouble, out)
    if page:
        print(
            f"dashboard: it was at {page}; `make demo ARGS=--stay` leaves it there (python tools/demo/demo.py --stay)"
        )
    return status


def look(watcher: PictureWatcher, processes: Processes, page: str) -> str | None:
    """Wait until Ctrl-C, or until a process ends; then say in a sentence which."""
    print(f"\nit goes on: {page}, Ctrl-C ends it", flush=True)
    try:
        return watcher.watch(math.inf, processes, patience_s=math.inf)
    except KeyboardInterrupt:
        print()
        return None


def conclude(watcher: PictureWatcher, codes: dict, memory: dict, trouble: str | None, out: Path) -> int:
    trouble = trouble_of(watcher, codes, trouble)
    if not watcher.good():
        print(f"\ndemo: {trouble}", file=sys.stderr)
        return 1
    summary, errors, covariance = summarise(watcher.good(), watcher.place)
    summary |= {"seconds_median": float(np.nanmedian(watcher.seconds)), "peak_memory_mb": memory}
    (out / "summary.json").write_text(json.dumps(summary, indent=1) + "\n")
    inside = say_errors(watcher, summary)
    took = ", ".join(f"{name} {mb} MB" for name, mb in memory.items() if name != "emulator")
    print(
        f"frame published to fix received: median {np.nanmedian(watcher.seconds):.2f} s"
        + (f"; peak memory {took}" if took else "")
    )
    drawn = picture(watcher, errors, covariance, out / "demo.png")
    print(f"picture: {out / 'demo.png'}" if drawn else "no picture: no frame with a fix was heard whole")
    heavy = {name: mb for name, mb in memory.items() if mb > MEMORY_LIMIT_MB}
    for name, mb in heavy.items():
        print(f"demo: {name} took {mb} MB, over the {MEMORY_LIMIT_MB} MB a node may take", file=sys.stderr)
    if trouble:
        print(f"demo: NOT ALL IS WELL: {trouble}", file=sys.stderr)
    return 0 if inside and not heavy and not trouble else 1


if __name__ == "__main__":
    sys.exit(main())

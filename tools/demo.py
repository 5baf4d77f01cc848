# SPDX-License-Identifier: Apache-2.0
"""The whole instrument under a simulated sky, live: four nodes as they are installed, an emulated inclinometer on a pty.

The place is drawn at random; nothing tells it to the solver.  Exit status 0 if the truth lies within 4 sigma and no
node took more memory than it may.  All of it runs in a ROS domain of its own: no other graph hears it.
"""

import argparse
import json
import math
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import deque
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

FRAMES, CADENCE_S, EXPOSURE_S, PATIENCE_S = 10, 3.0, 0.5, 75.0
ACCEPTED_SIGMA = 4.0
MEMORY_LIMIT_MB = 500  # of each node
FRAMES_KEPT = 3  # of 42 MB; a frame's solution comes before the third one after it


@dataclass(frozen=True)
class Place:
    """Where the demo's instrument stands, what it looks at, and how its parts are mounted; deg, Pa, deg C."""

    latitude: float
    longitude: float
    azimuth: float
    altitude: float
    roll: float
    misalignment: tuple[float, float, float]
    pressure: float = 95000.0
    temperature: float = 8.0
    humidity: float = 0.4

    @classmethod
    def drawn(cls, rng: np.random.Generator) -> "Place":
        latitude = math.degrees(math.asin(rng.uniform(-0.94, 0.94)))
        pointing = (rng.uniform(0, 360), rng.uniform(72, 84), rng.uniform(0, 360))
        return cls(
            latitude, rng.uniform(-180, 180), *pointing, (*rng.uniform(-1, 1, 2), rng.uniform(-180, 180))
        )

    def scene(self):
        from starpos.atmosphere import Atmosphere
        from starpos.simulate import scene_of

        air = Atmosphere(self.pressure, self.temperature, self.humidity)
        pointing = (self.azimuth, self.altitude, self.roll)
        return scene_of(
            latitude_deg=self.latitude,
            longitude_deg=self.longitude,
            atmosphere=air,
            pointing_deg=pointing,
            misalignment_deg=self.misalignment,
        )


@contextmanager
def own_domain():
    """A ROS_DOMAIN_ID that nobody has, least of all the graph of this shell, and only on this machine."""
    others = [n for n in range(1, 100) if str(n) != os.environ.get("ROS_DOMAIN_ID")]
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    os.environ.pop("ROS_STATIC_PEERS", None)
    try:
        from domain_coordinator import domain_id
    except ImportError:  # a robot without ros-jazzy-domain-coordinator
        os.environ["ROS_DOMAIN_ID"] = str(random.choice(others))
        yield
        return
    with domain_id(lambda: random.choice(others)) as number:
        os.environ["ROS_DOMAIN_ID"] = str(number)
        yield


def executable(package: str, name: str) -> str:
    from ament_index_python.packages import get_package_prefix

    return str(Path(get_package_prefix(package)) / "lib" / package / name)


class Instrument:
    """The processes; their output goes to files in `folder`."""

    def __init__(self, place: Place, folder: Path, seed: int):
        self.folder, self.running = folder, {}
        theta_x, theta_y = np.degrees(place.scene().tilt)
        self.link = folder / "inclinometer-port"
        air = {f"{k}": getattr(place, k) for k in ("pressure", "temperature", "humidity")}
        simulated = {
            k: getattr(place, k) for k in ("latitude", "longitude", "azimuth", "altitude", "roll")
        } | air
        camera = {"source": "simulated", "cadence": CADENCE_S, "exposure": EXPOSURE_S, "simulated.seed": seed}
        camera |= {f"simulated.{k}": v for k, v in simulated.items()}
        solver = {f"refraction.{k}": v for k, v in air.items()}
        solver["misalignment"] = "[" + ", ".join(f"{v:.9f}" for v in place.misalignment) + "]"
        self._start("starpos_inclinometer", "emulator", ["--link", str(self.link), "--tilt-x", f"{theta_x:.9f}",
                    "--tilt-y", f"{theta_y:.9f}", "--seed", str(seed)])  # fmt: skip
        self._start("starpos_inclinometer", "inclinometer", _parameters({"port": str(self.link)}))
        self._start("starpos_solver", "solver", _parameters(solver))
        self._start("starpos_camera", "detector", [])
        self._start("starpos_camera", "camera", _parameters(camera))

    def _start(self, package: str, name: str, arguments: list[str]):
        with open(self.folder / f"{name}.log", "w") as log:
            self.running[name] = subprocess.Popen(
                [executable(package, name), *arguments],
                stdout=log,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )

    def dead(self) -> str | None:
        """The name of a process that has ended, if any."""
        return next((name for name, p in self.running.items() if p.poll() is not None), None)

    def peak_mb(self) -> dict[str, int]:
        """Peak resident memory of each node, 10^6 bytes."""
        peak = {}
        for name, p in self.running.items():
            lines = Path(f"/proc/{p.pid}/status").read_text().splitlines()
            peak[name] = next(
                (round(int(n.split()[1]) * 1.024e-3) for n in lines if n.startswith("VmHWM")), 0
            )
        return peak

    def stop(self) -> dict[str, int | str]:
        """Stop all as launch does, with SIGINT; their exit codes."""
        for p in self.running.values():
            if p.poll() is None:
                os.killpg(p.pid, signal.SIGINT)
        codes = {}
        for name, p in self.running.items():
            try:
                codes[name] = p.wait(10)
            except subprocess.TimeoutExpired:
                os.killpg(p.pid, signal.SIGKILL)
                codes[name] = "killed"
        return codes


def _parameters(values: dict) -> list[str]:
    return ["--ros-args", *(a for k, v in values.items() for a in ("-p", f"{k}:={v}"))]


class Watcher:
    """Listens to the graph: solutions and publication times by the frame's stamp, and one solved frame, `pictured`."""

    def __init__(self, place: Place):
        import rclpy
        from sensor_msgs.msg import Image

        from starpos_interfaces.msg import Capture, Solution, StarArray

        rclpy.init()
        self.rclpy, self.node, self.place = rclpy, rclpy.create_node("demo"), place
        self.solutions, self.seconds, self.published, self.stars = {}, [], {}, {}
        self.frames, self.pictured = deque(maxlen=FRAMES_KEPT), None
        self.node.create_subscription(Solution, "solver/solution", self._on_solution, 10)
        self.node.create_subscription(Capture, "camera/capture", self._on_capture, 10)
        self.node.create_subscription(StarArray, "stars", lambda m: self.stars.update({_stamp(m): m}), 10)
        self.image = self.node.create_subscription(Image, "camera/image_raw", self._on_image, 1)

    def _on_capture(self, message):
        self.published[_stamp(message)] = time.monotonic()

    def _on_image(self, message):
        self.frames.append(message)

    def _on_solution(self, message):
        stamp = _stamp(message)
        if stamp in self.solutions:  # a frame that is solved again is no other frame
            return
        self.solutions[stamp] = message
        self.seconds.append(time.monotonic() - self.published.get(stamp, math.nan))
        if self.pictured is None and message.status == message.OK:
            self.pictured = next((frame for frame in self.frames if _stamp(frame) == stamp), None)
        print(_row(len(self.solutions), message, self.place, self.seconds[-1]), flush=True)

    def watch(self, frames: int, instrument: Instrument) -> str | None:
        """Until so many frames are solved; a sentence if it will not come to that."""
        end = time.monotonic() + PATIENCE_S
        while len(self.solutions) < frames:
            self.rclpy.spin_once(self.node, timeout_sec=0.2)
            if self.pictured is not None and self.image is not None:  # one 42 MB frame is enough
                self.node.destroy_subscription(self.image)
                self.image = None
                self.frames.clear()
            if name := instrument.dead():
                return f"{name} has stopped: see {instrument.folder / name}.log"
            if time.monotonic() > end:
                return f"{len(self.solutions)} of {frames} frames in {PATIENCE_S:.0f} s: see {instrument.folder}/*.log"
        return None

    def close(self):
        self.node.destroy_node()
        self.rclpy.try_shutdown()


def _stamp(message) -> tuple[int, int]:
    return message.header.stamp.sec, message.header.stamp.nanosec


def _error_m(latitude: float, longitude: float, place: Place) -> tuple[float, float]:
    """East and north of the truth."""
    from starpos.earth import curvature_radii_m

    phi = math.radians(place.latitude)
    prime_vertical, meridian = curvature_radii_m(phi)
    turn = math.radians((longitude - place.longitude + 180) % 360 - 180)
    return turn * prime_vertical * math.cos(phi), math.radians(latitude - place.latitude) * meridian


HEADER = "frame  stars  matched    latitude    longitude     heading  sigma, m  error, m  seconds"


def _row(number: int, s, place: Place, seconds: float) -> str:
    if s.status != s.OK:
        return f"{number:5d}  {s.stars_detected:5d}  {s.status_text}"
    sigma = math.sqrt((s.covariance[0] + s.covariance[4]) / 2)
    error = math.hypot(*_error_m(s.latitude, s.longitude, place))
    return (
        f"{number:5d}  {s.stars_detected:5d}  {s.stars_matched:7d}  {s.latitude:+10.5f}  {s.longitude:+11.5f}  "
        f"{s.heading:10.4f}  {sigma:8.0f}  {error:8.0f}  {seconds:7.2f}"
    )


def summarise(solutions: list, place: Place) -> tuple[dict, np.ndarray, np.ndarray]:
    """The mean fix against the truth: a dict for people and scripts, the errors (N, 2) m, the covariance of one fix."""
    errors = np.array([_error_m(s.latitude, s.longitude, place) for s in solutions])
    one = np.array(solutions[-1].covariance).reshape(3, 3)
    variance = np.zeros(2)
    for term in solutions[-1].budget:  # what is new in every frame averages, the rest stays
        if term.name == "deflection":  # of the geodetic position, which has no part in this
            continue
        share = 1 if term.common else len(solutions)
        variance += np.array([term.east, term.north]) ** 2 / share
    mean, sigma = errors.mean(0), np.sqrt(variance)
    headings = np.array([s.heading for s in solutions])
    truth = math.degrees(place.scene().heading)
    heading_error = float(((headings - truth + 180) % 360 - 180).mean() * 3600)
    summary = {
        "latitude": place.latitude,
        "longitude": place.longitude,
        "frames": len(solutions),
        "east_m": float(mean[0]),
        "north_m": float(mean[1]),
        "sigma_east_m": float(sigma[0]),
        "sigma_north_m": float(sigma[1]),
        "sigmas_off": float(np.max(np.abs(mean) / sigma)),
        "heading_error_arcsec": heading_error,
    }
    return summary, errors, one


def picture(watcher: Watcher, errors: np.ndarray, covariance: np.ndarray, path: Path) -> bool:
    """Draw the fixes and the frame that was kept; False where none was, or its stars were not heard."""
    from starpos import picture
    from starpos.annotate import Identified, annotate
    from starpos_common.messages import message_to_frame, message_to_stars

    frame, place = watcher.pictured, watcher.place
    if frame is None or _stamp(frame) not in watcher.stars:
        return False
    solution, stars = watcher.solutions[_stamp(frame)], message_to_stars(watcher.stars[_stamp(frame)])
    known = Identified(solution.indices, solution.ids, solution.magnitudes)
    shown = annotate(message_to_frame(frame), stars, known)
    title = (
        f"starpos at {place.latitude:+.4f} {place.longitude:+.4f}: {len(errors)} frames of {EXPOSURE_S:g} s"
    )
    about = f"a frame and its {len(solution.ids)} identified stars"
    picture.draw(path, errors, covariance[:2, :2], title, shown, about)
    return True


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--seed", type=int, help="another place and sky for another seed, 0 to 2147483647 (default: drawn)"
    )
    parser.add_argument("--frames", type=int, default=FRAMES)
    parser.add_argument(
        "--out", type=Path, default=Path("demo"), help="folder of the picture, the summary and the logs"
    )
    args = parser.parse_args()
    seed = int.from_bytes(os.urandom(4), "big") >> 1 if args.seed is None else args.seed
    if not 0 <= seed < 2**31:
        parser.error(f"--seed {seed} is not from 0 to 2147483647")
    with own_domain():
        return run(seed, args.frames, args.out)


def run(seed: int, frames: int, out: Path) -> int:
    """The demo; its exit status."""
    out.mkdir(parents=True, exist_ok=True)
    place = Place.drawn(np.random.default_rng(seed))
    air = f"{place.pressure / 100:.0f} hPa, {place.temperature:g} deg C"
    print(
        f"seed {seed}: the instrument stands at {place.latitude:+.5f} {place.longitude:+.5f}, {air}; it is not told where"
    )
    print(
        "four nodes and an emulated inclinometer; the first run sorts the sky's triangles, some seconds, once\n"
    )
    print(HEADER)
    with tempfile.TemporaryDirectory() as scratch:  # a pty's link wants a short path
        folder = Path(scratch)
        watcher = Watcher(place)
        instrument = Instrument(place, folder, seed)
        try:
            trouble = watcher.watch(frames, instrument)
            memory = {} if trouble else instrument.peak_mb()
        except KeyboardInterrupt:
            trouble, memory = "interrupted", {}
        codes = instrument.stop()
        for log in folder.glob("*.log"):
            shutil.copy(log, out)
    watcher.close()
    return conclude(watcher, codes, memory, trouble, out)


def conclude(watcher: Watcher, codes: dict, memory: dict, trouble: str | None, out: Path) -> int:
    good = [s for s in watcher.solutions.values() if s.status == s.OK]
    unclean = {name: code for name, code in codes.items() if code != 0}
    if trouble or not good or unclean:
        print(
            f"\ndemo: {trouble or (f'unclean exits {unclean}' if unclean else 'no frame gave a fix')}",
            file=sys.stderr,
        )
        return 1
    summary, errors, covariance = summarise(good, watcher.place)
    summary |= {"seconds_median": float(np.nanmedian(watcher.seconds)), "peak_memory_mb": memory}
    (out / "summary.json").write_text(json.dumps(summary, indent=1) + "\n")
    print(
        f"\n{summary['frames']} fixes together: {summary['north_m']:+.0f} m north, {summary['east_m']:+.0f} m east "
        f"of the truth, claimed {summary['sigma_north_m']:.0f} and {summary['sigma_east_m']:.0f} m; "
        f"heading {summary['heading_error_arcsec']:+.1f} arcsec"
    )
    print(
        f"frame published to fix received: median {np.nanmedian(watcher.seconds):.2f} s; peak memory "
        + ", ".join(f"{name} {mb} MB" for name, mb in memory.items() if name != "emulator")
    )
    drawn = picture(watcher, errors, covariance, out / "demo.png")
    print(f"picture: {out / 'demo.png'}" if drawn else "no picture: no frame with a fix was heard whole")
    inside = summary["sigmas_off"] < ACCEPTED_SIGMA and len(good) == len(watcher.solutions)
    print(
        "the truth lies within 4 sigma"
        if inside
        else "the truth lies OUTSIDE 4 sigma, or a frame gave no fix"
    )
    heavy = {name: mb for name, mb in memory.items() if mb > MEMORY_LIMIT_MB}
    for name, mb in heavy.items():
        print(f"demo: {name} took {mb} MB, over the {MEMORY_LIMIT_MB} MB a node may take", file=sys.stderr)
    return 0 if inside and not heavy else 1


if __name__ == "__main__":
    sys.exit(main())

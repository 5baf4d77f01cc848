# SPDX-License-Identifier: Apache-2.0
"""Run of the installed nodes for some frames at a place unknown to them, and comparison with it.

tools/demo/demo.py and tools/demo/emulated_instrument.py share this.
"""

import argparse
import math
import os
import signal
import subprocess
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np

PATIENCE_S = 75.0
ACCEPTED_SIGMA = 4.0


@dataclass(frozen=True, kw_only=True)
class Place:
    """The place of the instrument, its pointing, and the mounting of its parts; deg, Pa, deg C."""

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
        pointing = {
            "azimuth": rng.uniform(0, 360),
            "altitude": rng.uniform(72, 84),
            "roll": rng.uniform(0, 360),
        }
        misalignment = (*rng.uniform(-1, 1, 2), rng.uniform(-180, 180))
        return cls(latitude=latitude, longitude=rng.uniform(-180, 180), **pointing, misalignment=misalignment)

    def scene(self):
        from starpos.earth.refraction import Atmosphere
        from starpos.simulation.scene import scene_of

        air = Atmosphere(pressure_pa=self.pressure, temperature_c=self.temperature, humidity=self.humidity)
        pointing = (self.azimuth, self.altitude, self.roll)
        return scene_of(
            latitude_deg=self.latitude,
            longitude_deg=self.longitude,
            atmosphere=air,
            pointing_deg=pointing,
            misalignment_deg=self.misalignment,
        )


def executable(package: str, name: str) -> str:
    from ament_index_python.packages import get_package_prefix

    return str(Path(get_package_prefix(package)) / "lib" / package / name)


class Processes:
    """Programs that run until `stop`; the output of each goes to a file in `folder`."""

    def __init__(self, folder: Path):
        self.folder, self.running = folder, {}

    def start(self, name: str, command: list[str], **options) -> subprocess.Popen:
        """Start a program; options: as for Popen."""
        with open(self.folder / f"{name}.log", "w") as log:
            options = {"stdout": log, "stderr": log, "start_new_session": True} | options
            self.running[name] = subprocess.Popen(command, **options)
        return self.running[name]

    def node(self, package: str, name: str, parameters: dict) -> None:
        """Start a node with its parameters."""
        options = [word for k, v in parameters.items() for word in ("-p", f"{k}:={v}")]
        self.start(name, [executable(package, name), "--ros-args", *options])

    def dead(self) -> str | None:
        """Say in a sentence which process has ended, if one has."""
        name = next((name for name, p in self.running.items() if p.poll() is not None), None)
        if name is None:
            return None
        said = (self.folder / f"{name}.log").read_text(errors="replace").splitlines() or ["nothing"]
        return f"{name} {ending_of(self.running[name].returncode)}; it said last: {said[-1]}"

    def peak_mb(self) -> dict[str, int]:
        """Peak resident memory of each process, 10^6 bytes."""
        peak = {}
        for name, p in self.running.items():
            lines = Path(f"/proc/{p.pid}/status").read_text().splitlines()
            peak[name] = next(
                (round(int(n.split()[1]) * 1.024e-3) for n in lines if n.startswith("VmHWM")), 0
            )
        return peak

    def stop(self) -> dict[str, int | str]:
        """Stop all processes with SIGINT, as launch does; return their exit codes."""
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


def ending_of(code: int | str) -> str:
    """Say how a process ended, by its exit code."""
    if code == "killed":
        return "did not end when it was asked to, and was killed"
    try:
        return f"was ended by {signal.Signals(-code).name}" if code < 0 else f"ended with status {code}"
    except ValueError:
        return f"was ended by signal {-code}"


def known_of(place: Place) -> dict:
    """Parameters of the solver that a user knows who sets up the instrument there, without the place."""
    known = {f"refraction.{k}": getattr(place, k) for k in ("pressure", "temperature", "humidity")}
    known["misalignment_stddev"] = 5.0
    known["inclinometer.model"] = "sca100t_calibrated"
    known["misalignment"] = "[" + ", ".join(f"{v:.9f}" for v in place.misalignment) + "]"
    return known


class Watcher:
    """Listens to the graph: solutions, how the frames were taken, and the time to a fix, each by the frame's stamp."""

    def __init__(self, place: Place):
        import rclpy

        from starpos_interfaces.msg import Capture, Solution

        rclpy.init()
        self.rclpy, self.node, self.place = rclpy, rclpy.create_node("watcher"), place
        self.solutions, self.captures, self.seconds, self._heard = {}, {}, [], {}
        self.node.create_subscription(Solution, "solver/solution", self._on_solution, 10)
        self.node.create_subscription(Capture, "camera/capture", self._on_capture, 10)

    def _on_capture(self, message):
        self.captures[stamp_of(message)] = message
        self._heard[stamp_of(message)] = time.monotonic()

    def _on_solution(self, message):
        stamp = stamp_of(message)
        # A frame that is solved again does not count twice.
        if stamp in self.solutions:
            return
        if not self.solutions:
            print(f"\n{HEADER}")
        self.solutions[stamp] = message
        self.seconds.append(time.monotonic() - self._heard.get(stamp, math.nan))
        print(_row(len(self.solutions), message, self.place, self.seconds[-1]), flush=True)

    def watch(self, frames: float, *processes: Processes, patience_s: float = PATIENCE_S) -> str | None:
        """Wait until a number of frames is solved; return a sentence if that will not happen."""
        end = time.monotonic() + patience_s
        while len(self.solutions) < frames:
            self.rclpy.spin_once(self.node, timeout_sec=0.2)
            if dead := next((sentence for p in processes if (sentence := p.dead())), None):
                return dead
            if time.monotonic() > end:
                logs = processes[0].folder
                return f"{len(self.solutions)} of {frames} frames in {patience_s:.0f} s: see {logs}/*.log"
        return None

    def good(self) -> list:
        """Solutions that are fixes."""
        return [s for s in self.solutions.values() if s.status == s.OK]

    def close(self):
        self.node.destroy_node()
        self.rclpy.try_shutdown()


def stamp_of(message) -> tuple[int, int]:
    return message.header.stamp.sec, message.header.stamp.nanosec


def _error_m(latitude: float, longitude: float, place: Place) -> tuple[float, float]:
    """Errors of a solution to the east and north of the truth, m."""
    from starpos.earth.ellipsoid import curvature_radii_m

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
    """Compare the mean fix with the truth; return a summary, the errors (N, 2) m, and the covariance of one fix."""
    errors = np.array([_error_m(s.latitude, s.longitude, place) for s in solutions])
    one = np.array(solutions[-1].covariance).reshape(3, 3)
    variance = np.zeros(2)
    # Errors that are new in every frame average out, the others stay.
    for term in solutions[-1].budget:
        # It concerns the geodetic position, which is not compared here.
        if term.name == "deflection":
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


def trouble_of(watcher: Watcher, codes: dict, trouble: str | None) -> str | None:
    """Say in a sentence that there is no fix to compare, or that a program has failed; None if all is well."""
    unclean = [f"{name} {ending_of(code)}" for name, code in codes.items() if code != 0]
    if trouble or unclean:
        return trouble or "; ".join(unclean)
    if watcher.good():
        return None
    return f"none of {len(watcher.solutions)} frames gave a fix: {why_none(watcher.solutions.values())}"


def why_none(solutions) -> str:
    """Count the solutions without a fix by their status."""
    lost = [s for s in solutions if s.status != s.OK]
    # the message's constants name its status
    constants = [(name, getattr(s, name)) for s in lost[:1] for name in dir(s) if name.isupper()]
    names = {number: name for name, number in constants if isinstance(number, int)}
    told = Counter(names[s.status].replace("_", " ").lower() for s in lost)
    return ", ".join(f"{text} ({number})" for text, number in told.most_common())


def say_errors(watcher: Watcher, summary: dict) -> bool:
    """Print the mean fix and the truth; return whether they agree within ACCEPTED_SIGMA and no frame lacked a fix.

    Frames before the first fix do not count: an inclinometer may start in the middle of an exposure.
    """
    print(
        f"\n{summary['frames']} fixes together: {summary['north_m']:+.0f} m north, {summary['east_m']:+.0f} m east "
        f"of the truth, claimed {summary['sigma_north_m']:.0f} and {summary['sigma_east_m']:.0f} m; "
        f"heading {summary['heading_error_arcsec']:+.1f} arcsec"
    )
    solutions = list(watcher.solutions.values())
    first = next(k for k, s in enumerate(solutions) if s.status == s.OK)
    lost = [s for s in solutions[first:] if s.status != s.OK]
    inside = summary["sigmas_off"] < ACCEPTED_SIGMA
    side = "within" if inside else "OUTSIDE"
    print(f"the truth lies {side} {ACCEPTED_SIGMA:g} sigma: {summary['sigmas_off']:.1f} sigma off")
    if lost:
        print(f"NOT ALL IS WELL: {len(lost)} of {len(solutions)} frames gave no fix: {why_none(lost)}")
    return inside and not lost


def parser_of(text: str, frames: int, out: str) -> argparse.ArgumentParser:
    """Make the parser of a command with --seed, --frames and --out."""
    parser = argparse.ArgumentParser(description=text, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--seed", type=int, help="another place and sky for another seed, 0 to 2147483647 (default: drawn)"
    )
    parser.add_argument("--frames", type=int, default=frames)
    parser.add_argument("--out", type=Path, default=Path(out), help="folder of the summary and the logs")
    return parser


def parse(parser: argparse.ArgumentParser) -> argparse.Namespace:
    """Parse the arguments; a seed is drawn if none is given."""
    args = parser.parse_args()
    if args.seed is None:
        args.seed = int.from_bytes(os.urandom(4), "big") >> 1
    if not 0 <= args.seed < 2**31:
        parser.error(f"--seed {args.seed} is not from 0 to 2147483647")
    if args.frames < 1:
        parser.error(f"--frames {args.frames} is not 1 or more")
    return args


def introduce(seed: int, place: Place, who: str):
    """Print the place, and what runs."""
    air = f"{place.pressure / 100:.0f} hPa, {place.temperature:g} deg C"
    print(
        f"seed {seed}: the instrument stands at {place.latitude:+.5f} {place.longitude:+.5f}, {air}; it is not told where"
    )
    print(f"{who}; the first run sorts the sky's triangles, some seconds, once")

# SPDX-License-Identifier: Apache-2.0
"""Times and costs of the installed nodes: start to first fix, frame to fix, stars to fix, CPU, memory.

Prints a table in Markdown with the targets.  Exit status 1 if one is missed.  A frame waits for the tilts of its
exposure, so they are sent before it.  The first run on a machine builds the sky's triangles before anything is timed.
"""

import os
import signal
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from statistics import median

import table

from starpos_testing.domain import own_domain

ROOT = Path(__file__).resolve().parents[2]

QUICK_START = ROOT / "src" / "starpos_bringup" / "config" / "quick_start.xml"
PROFILES = "FASTRTPS_DEFAULT_PROFILES_FILE"
# Targets of the medians.
FIRST_FIX_S, SOLVER_S, FRAME_S, STARS_S = 3.0, 1.0, 0.6, 0.02
# Frames of 42 MB on disk, played again and again.
FILES = 8
CADENCE_S = 1.0
# Frames before the timing begins.
SETTLED = 3


@dataclass(frozen=True)
class Row:
    """A measurement; target: for the median, None without one."""

    what: str
    values: list[float]
    unit: str
    target: float | None = None

    @property
    def missed(self) -> bool:
        return self.target is not None and not (self.values and median(self.values) < self.target)

    def __str__(self) -> str:
        digits = 1 if self.unit == "MB" else 3
        middle = f"{median(self.values):.{digits}f}" if self.values else "none came"
        most = f"{max(self.values):.{digits}f}" if len(self.values) > 1 else ""
        target = "" if self.target is None else f"{self.target:g}{' MISSED' * self.missed}"
        return f"| {self.what} | {len(self.values)} | {middle} | {most} | {self.unit} | {target} |"


class Ears:
    """Notes when fixes with a position and captures were heard, by their stamps."""

    def __init__(self, graph):
        from sensor_msgs.msg import NavSatFix

        from starpos_interfaces.msg import Capture

        self.fixes, self.captures = {}, {}
        graph.node.create_subscription(NavSatFix, "fix", self._on_fix, 100)
        graph.node.create_subscription(Capture, "camera/capture", self._on_capture, 100)

    def _on_fix(self, message):
        if message.status.status >= 0:
            self.fixes.setdefault(stamp_of(message), time.monotonic())

    def _on_capture(self, message):
        self.captures[stamp_of(message)] = time.monotonic()


def stamp_of(message) -> tuple[int, int]:
    return message.header.stamp.sec, message.header.stamp.nanosec


class Run:
    """Make a graph, and nodes that end with it."""

    def __init__(self, folder: Path):
        from starpos_testing.graph.graph import Graph

        self.folder, self.graph, self._count = folder, Graph(), 0
        self.ears = Ears(self.graph)

    def start(self, package: str, name: str, *parameters: str, arguments=()):
        self._count += 1
        log = self.folder / f"{time.monotonic_ns()}-{name}.log"
        return self.graph.start(log, package, name, *parameters, arguments=arguments)

    def inclinometer(self, tilt_deg=(3.0, 2.0)):
        """Emulate an inclinometer on a pty; gives the port, and the node to start on it."""
        port = self.folder / f"port{time.monotonic_ns()}"
        arguments = ("--link", str(port), "--tilt-x", f"{tilt_deg[0]:.9f}", "--tilt-y", f"{tilt_deg[1]:.9f}")
        self.start("starpos_testing", "emulator", arguments=arguments)
        self.graph.wait(port.exists, "for the emulated port")
        return f"port:={port}"

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.graph.close()


def from_start(folder: Path, starts: int) -> Row:
    """Time solver, camera_detector and inclinometer from exec to the first fix.

    Frames are small here, because the simulated sky takes a second to draw a whole one.
    """
    import numpy as np

    from starpos.simulation.scene import scene_of
    from starpos_testing.graph.shots import SMALL, SOLVER, focal_of

    tilt = np.degrees(scene_of(SMALL, focal_of(SMALL)).tilt)
    sky = ("source:=simulated", "cadence:=0.6", f"focal_mm:={focal_of(SMALL) * 6.4e-3}")
    sky += (f"simulated.width:={SMALL[0]}", f"simulated.height:={SMALL[1]}")
    seconds = []
    for _ in range(starts):
        with Run(folder) as run:
            port = run.inclinometer(tilt)
            begin = time.monotonic()
            run.start("starpos_solver", "solver", *SOLVER)
            run.start("starpos_camera", "camera_detector", *sky)
            run.start("starpos_inclinometer", "inclinometer", port)
            run.graph.wait(lambda run=run: run.ears.fixes, "for the first fix")
            seconds.append(min(run.ears.fixes.values()) - begin)
    return Row("solver, camera_detector and inclinometer started to first fix", seconds, "s", FIRST_FIX_S)


def from_start_of_solver(folder: Path, starts: int) -> Row:
    """Time the solver alone from exec to the first fix, while stars and tilts come all the time."""
    from starpos_testing.graph.shots import SOLVER, shoot

    seconds, shot = [], shoot()
    for _ in range(starts):
        with Run(folder) as run:
            begin = time.monotonic()
            run.start("starpos_solver", "solver", *SOLVER)
            run.graph.wait(lambda run=run: run.ears.fixes or run.graph.send(shot), "for the first fix")
            seconds.append(min(run.ears.fixes.values()) - begin)
    return Row("solver started to the first fix of stars that come all the time", seconds, "s", SOLVER_S)


def from_stars(folder: Path, frames: int) -> Row:
    """Time from publishing a star message to receiving its fix."""
    from starpos_testing.graph.shots import SOLVER, shoot

    seconds = []
    with Run(folder) as run:
        run.start("starpos_solver", "solver", *SOLVER)
        run.graph.wait_for_solver()
        for k in range(frames + SETTLED):
            shot = shoot()
            run.graph.info.publish(shot.info)
            for tilt in shot.tilts:
                run.graph.tilt.publish(tilt)
            # Meanwhile the tilts of a second have come.
            run.graph.comes(lambda: False, 0.1)
            begin = time.monotonic()
            run.graph.stars.publish(shot.stars)
            run.graph.wait(lambda shot=shot: shot.stamp in run.ears.fixes, "for a fix")
            if k >= SETTLED:
                seconds.append(run.ears.fixes[shot.stamp] - begin)
    return Row("star message published to fix received", seconds, "s", STARS_S)


def write_frames(folder: Path):
    """Draw FILES frames of the paper's camera and the tilts of each, in order of time."""
    import numpy as np

    from starpos.simulation.scene import expose, render, scene_of, write_fits
    from starpos.sky.catalogue import load_catalogue
    from starpos.units import utc_text
    from starpos_testing.graph.shots import EXPOSURE_S, NOISE_DEG, START_S, tilts_of

    rng, scene, tilts = np.random.default_rng(1), scene_of(tilt_noise_deg=NOISE_DEG), []
    for k in range(FILES):
        start = START_S + 10.0 * k
        light = expose(scene, load_catalogue(), start, EXPOSURE_S, rng)
        frame = render(scene, light, start, EXPOSURE_S, rng)
        write_fits(folder / f"{k}.fits", frame, utc_text(start))
        tilts += tilts_of(scene, start, rng)
    return tilts


def from_frames(folder: Path, frames: int, together: bool) -> list[Row]:
    """Play frames of 21 megapixels from a disk at 1 Hz: time from capture message to fix, CPU and memory."""
    from starpos_testing.graph.shots import SOLVER
    from starpos_testing.processes import cpu_s

    names = ("camera_detector",) if together else ("camera", "detector")
    where = "camera and detector in one process" if together else "camera and detector as two processes"
    pictures = folder / "frames"
    if not pictures.exists():
        pictures.mkdir()
        from_frames.tilts = write_frames(pictures)
    with Run(folder) as run:
        nodes = {"solver": run.start("starpos_solver", "solver", *SOLVER)}
        # its tilts are of now and the frames of 2024, so the solver must not hear it: their clocks would seem to jump
        apart = ("--ros-args", "-r", "tilt:=tilt_of_now")
        port = run.inclinometer()
        nodes["inclinometer"] = run.start("starpos_inclinometer", "inclinometer", port, arguments=apart)
        run.graph.wait(lambda: run.graph.tilt.get_subscription_count() > 0)
        for tilt in from_frames.tilts:
            run.graph.tilt.publish(tilt)
        camera = ("source:=files", f"files.path:={pictures}", "files.loop:=true", f"cadence:={CADENCE_S}")
        for name in reversed(names):
            nodes[name] = run.start("starpos_camera", name, *(() if name == "detector" else camera))
        run.graph.wait(lambda: len(run.ears.fixes) >= min(SETTLED, FILES), "for the first fixes")
        seconds, begin = [], time.monotonic()
        before = {name: cpu_s(node.process.pid) for name, node in nodes.items()}
        while len(seconds) < frames and time.monotonic() < begin + 2 * frames * CADENCE_S + 20:
            run.ears.fixes.clear()
            run.ears.captures.clear()
            run.graph.comes(lambda: set(run.ears.fixes) & set(run.ears.captures), 2 * CADENCE_S)
            both = set(run.ears.fixes) & set(run.ears.captures)
            seconds += [run.ears.fixes[s] - run.ears.captures[s] for s in both]
        passed = time.monotonic() - begin
        share = {n: (cpu_s(p.process.pid) - before[n]) / passed for n, p in nodes.items()}
        peak = {n: peak_mb(p.process.pid) for n, p in nodes.items()}
    rows = [Row(f"21 Mpx frame published to fix received, {where}", seconds, "s", FRAME_S)]
    for name in nodes:
        rows.append(Row(f"{name}: CPU at 1 Hz ({where})", [share[name]], "s/s"))
        rows.append(Row(f"{name}: peak memory", [peak[name]], "MB"))
    return rows


def peak_mb(pid: int) -> float:
    """Peak resident memory of a process."""
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    return next(int(line.split()[1]) * 1.024e-3 for line in lines if line.startswith("VmHWM"))


def rows(options) -> Iterator[table.Row]:
    """The rows of bench.py: CPU time of the nodes, a frame; with --quick none."""
    if options.quick:
        return
    choose(str(QUICK_START))
    with own_domain(), tempfile.TemporaryDirectory() as folder:
        for together in (False, True):
            for row in from_frames(Path(folder), 15, together):
                if row.unit == "s/s":
                    yield table.Row(
                        f"a 21 Mpx frame a second, node {row.what.replace(': CPU at 1 Hz', '')}",
                        table.Cost(1000 * median(row.values)),
                        "real time",
                        table.Cost(1000 * CADENCE_S),
                    )


def choose(profile: str) -> None:
    """Set the Fast DDS profiles of all nodes; '' means without, even if the shell has some."""
    if profile:
        os.environ[PROFILES] = profile
    else:
        os.environ.pop(PROFILES, None)


def options(parser) -> None:
    parser.add_argument("--frames", type=int, default=100)
    parser.add_argument("--starts", type=int, default=5)
    parser.add_argument("--only", default="start,stars,frames")
    parser.add_argument(
        "--profile", default=str(QUICK_START), help="Fast DDS profiles of all nodes; '' for its own"
    )


def run(options) -> int:
    only, rows = options.only.split(","), []
    choose(options.profile)
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    with own_domain(), tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        if "start" in only:
            # This fills the cache.
            from_start(folder, 1)
            rows.append(from_start(folder, options.starts))
            rows.append(from_start_of_solver(folder, options.starts))
        if "stars" in only:
            rows.append(from_stars(folder, options.frames))
        if "frames" in only:
            rows += from_frames(folder, options.frames, together=False)
            rows += from_frames(folder, options.frames, together=True)
    print("| what | measured | median | most | unit | target |\n| --- | ---: | ---: | ---: | --- | --- |")
    print("\n".join(map(str, rows)))
    load = os.getloadavg()[0]
    print(f"\n{os.cpu_count()} cores, load {load:.1f} at the end")
    return int(any(row.missed for row in rows))

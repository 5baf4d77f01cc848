# SPDX-License-Identifier: Apache-2.0
"""A camera at 20 and 30 frames a second through detector and solver: which frames' attitudes come, and how soon.

The camera is another driver's: mono8, no Capture; tilts come at 100 Hz.  Frames are drawn before their time
and published when it has come.  Prints a table in Markdown; exit status 1 where a frame's attitude is missing or late.
"""

import os
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import median

from latency import ROOT, choose

from starpos_testing.domain import own_domain

PROFILE = ROOT / "src" / "starpos_bringup" / "config" / "large_frames.xml"
# size in px, frames a second
CASES = {"1280x960": ((1280, 960), 30.0), "1920x1080": ((1920, 1080), 20.0)}
EXPOSURE_S, TILTS_HZ = 0.025, 100.0
# Light that gives such an exposure about 50 stars, and the step from 14 bits to 8.
ZERO_POINT_E_S, SHIFT = 6.0e7, 2
LATE_S = 0.1
# Seconds of frames before those that count: the triangles come from the cache, the detector learns who sends.
SETTLED_S = 4.0
# what drawing may take beyond the time of the first frame
SLOWER = 2.0


@dataclass(frozen=True)
class Run:
    """What came of a case: delays of the attitudes that came (s), of how many frames; CPU (s) a frame, memory (MB)."""

    name: str
    rate_hz: float
    frames: int
    delays_s: list[float]
    cpu_s: dict[str, float]
    memory_mb: dict[str, tuple[float, float]]

    @property
    def missed(self) -> bool:
        return len(self.delays_s) < self.frames or max(self.delays_s) > LATE_S

    def __str__(self) -> str:
        came, soon = len(self.delays_s), sum(d <= LATE_S for d in self.delays_s)
        delays = sorted(self.delays_s)
        said = (
            [f"{1e3 * d:.0f}" for d in (median(delays), delays[int(0.99 * came)], delays[-1])]
            if came
            else ["-"] * 3
        )
        cpu = ", ".join(f"{name} {1e3 * s:.1f}" for name, s in self.cpu_s.items())
        memory = ", ".join(f"{name} {a:.0f} to {b:.0f}" for name, (a, b) in self.memory_mb.items())
        words = (
            f"{self.name} at {self.rate_hz:g} Hz",
            f"{came} of {self.frames}",
            f"{soon} of {self.frames}",
            *said,
            cpu,
            memory,
        )
        return f"| {' | '.join(words)} |{' MISSED' * self.missed}"


HEAD = (
    "| camera | attitudes | within 100 ms | median, ms | 99 %, ms | most, ms | CPU a frame, ms | memory, MB |\n"
    "| --- | ---: | ---: | ---: | ---: | ---: | --- | --- |"
)


def scene_of(size):
    from starpos_testing.graph.shots import scene_at

    scene = scene_at(size=size)
    return replace(scene, optics=replace(scene.optics, zero_point_e_s=ZERO_POINT_E_S))


def draw(scene, begin_s: float, frames: int, rate_hz: float) -> Iterator[tuple[float, bytearray]]:
    """Middles of exposures with their images as DDS carries them."""
    import numpy as np
    from rclpy.serialization import serialize_message

    from starpos.simulation.scene import expose, render
    from starpos.sky.catalogue import load_catalogue
    from starpos_common.messages import frame_to_message
    from starpos_testing.graph.shots import FRAME

    rng, catalogue = np.random.default_rng(1), load_catalogue()
    for k in range(frames):
        start_s = begin_s + k / rate_hz
        light = expose(scene, catalogue, start_s, EXPOSURE_S, rng)
        frame = render(scene, light, start_s, EXPOSURE_S, rng)
        frame = replace(frame, pixels=(frame.pixels >> SHIFT).astype(np.uint8))
        yield frame.mid_unix_s, serialize_message(frame_to_message(frame, FRAME))


def measure(name: str, seconds: float, folder: Path) -> Run:
    """Publish the frames of a case at their times."""
    import numpy as np
    from runner import Memory

    from starpos_common.messages import camera_to_message
    from starpos_interfaces.msg import Attitude
    from starpos_testing.graph.graph import Graph
    from starpos_testing.graph.shots import FRAME, SOLVER, tilts_at
    from starpos_testing.processes import cpu_s

    size, rate_hz = CASES[name]
    scene, number = scene_of(size), int((seconds + SETTLED_S) * rate_hz)
    # the catalogue is read with the first
    for _ in range(2):
        took_s = time.monotonic()
        next(draw(scene, time.time(), 1, rate_hz))
        took_s = time.monotonic() - took_s
    begin_s = time.time() + SLOWER * (number * took_s + 5.0)
    frames = list(draw(scene, begin_s, number, rate_hz))
    graph = Graph()
    # a publisher of Captures would be waited for
    graph.node.destroy_publisher(graph.capture)
    try:
        solver = graph.start(folder / "solver", "starpos_solver", "solver", *SOLVER)
        detector = graph.start(
            folder / "detector", "starpos_camera", "detector", "stamp:=middle", f"exposure:={EXPOSURE_S}"
        )
        nodes = {"detector": detector.process.pid, "solver": solver.process.pid}
        graph.wait(lambda: graph.stars.get_subscription_count() and graph.image.get_subscription_count())
        graph.info.publish(camera_to_message(scene.camera, FRAME, frames[0][0]))
        came_s: dict[float, float] = {}

        def hear(message: Attitude) -> None:
            t = message.header.stamp.sec + message.header.stamp.nanosec * 1e-9
            came_s.setdefault(round(t, 5), time.time())

        graph.node.create_subscription(Attitude, "attitude", hear, 1000)
        assert time.time() < begin_s, "drawing took too long: give fewer seconds"
        rng = np.random.default_rng(2)
        times = np.arange(begin_s - 1.0, begin_s + number / rate_hz + 0.5, 1 / TILTS_HZ)
        todo = [(t + 0.005, graph.tilt, m) for t, m in zip(times, tilts_at(scene, times, rng), strict=True)]
        todo += [(mid_s + EXPOSURE_S / 2 + 0.005, graph.image, bytes(m)) for mid_s, m in frames]
        sent_s, before, memory = {}, {}, {}
        mids = iter([round(mid_s, 5) for mid_s, _ in frames])
        counted = 0
        for due_s, publisher, message in sorted(todo, key=lambda row: row[0]):
            while (left_s := due_s - time.time()) > 0:
                graph.spin_once(left_s)
            if publisher is graph.image:
                sent_s[next(mids)] = time.time()
                if due_s > begin_s + SETTLED_S and not before:
                    before = {n: cpu_s(pid) for n, pid in nodes.items()}
                    memory = {n: Memory(pid) for n, pid in nodes.items()}
                    counted = len(sent_s) - 1
                elif memory:
                    for m in memory.values():
                        m.look()
            publisher.publish(message)
        graph.comes(lambda: len(came_s) == number, 2.0)
        passed = {n: cpu_s(pid) - before[n] for n, pid in nodes.items()}
    finally:
        graph.close()
    counting = sorted(sent_s)[counted:]
    return Run(
        name,
        rate_hz,
        len(counting),
        [came_s[t] - sent_s[t] for t in counting if t in came_s],
        {n: s / len(counting) for n, s in passed.items()},
        {n: m.halves for n, m in memory.items()},
    )


def options(parser) -> None:
    parser.add_argument("--seconds", type=float, default=10.0, help="of frames in a case (10)")
    parser.add_argument("--only", default=",".join(CASES), help=f"cases of {', '.join(CASES)}")


def run(options) -> int:
    choose(str(PROFILE))
    runs = []
    with own_domain(), tempfile.TemporaryDirectory() as scratch:
        for name in options.only.split(","):
            runs.append(measure(name, options.seconds, Path(scratch)))
    print("\n".join([HEAD, *map(str, runs)]))
    print(f"\n{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f} at the end")
    return int(any(r.missed for r in runs))

# SPDX-License-Identifier: Apache-2.0
"""The inclinometer's process stands still (SIGSTOP) for 0.5 to 10 s while the instrument turns: its tilts, and the fixes.

Each instrument is an inclinometer on a pseudo-terminal (the microcontroller with its clock, or lines of text without
one), the nodes `inclinometer` and `solver`, and star lists of what it points at, in real time. A tilt is wrong if the
instrument did not lean so at its stamp, unless its flags say that its time is not known. A fix is wrong beyond 5 of its
own sigmas. Prints one line. Exit status 0 only with nothing wrong, and a fix after every stall.
"""

import multiprocessing
import signal
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import numpy as np
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import QoSProfile
from runner import seed_of_the_day
from sensor_msgs.msg import CameraInfo, NavSatFix

from starpos.messages.stamp import stamp_to_unix
from starpos.messages.tilt import UNUSABLE
from starpos_interfaces.msg import StarArray, Tilt
from starpos_testing.graph.graph import Executable
from starpos_testing.nodes import take_domain
from starpos_testing.patience import WAIT_S

STALL_S = (0.5, 10.0)
# How far a stamp may be off: a device's clock gives times to some ms, on a busy machine at the start to some tens. A
# line without one is late by up to a period, and JITTER_S of starpos_inclinometer.clock, before it can be noticed.
STAMP_S = {"serial": 0.1, "ascii": 0.25}
TILT_SIGMAS = 6.0
# Patiences of solvers with a frame whose tilts have not come.
TIMEOUTS_S = (0.5, 8.0)
LATE_S = 1.0


class Instrument:
    """One inclinometer with its nodes, the star lists of its camera, and a judge of what comes out."""

    def __init__(self, node, folder: Path, number: int, seed: int):
        from accelerated import parameters_of
        from leaning import DEVICES, Motion

        self.name, self.source = f"i{number}", list(DEVICES)[number % len(DEVICES)]
        self._rng = np.random.default_rng([seed, number])
        begin_s = time.monotonic()
        self._unix_s = time.time() - time.monotonic()
        self._motion = Motion(1000 * seed + number, begin_s)
        self._exposures = self._motion.exposures(self._rng)
        self._next = next(self._exposures)
        self.counts: Counter[str] = Counter()
        self.wrong: list[str] = []
        self._until_s, self._stands, self._resumed_s, self._seen_fix = float("inf"), False, begin_s, False
        path = str(folder / self.name)
        self.device = multiprocessing.get_context("spawn").Process(
            target=DEVICES[self.source], args=(path, 1000 * seed + number, begin_s), daemon=True
        )
        self.device.start()
        solver = parameters_of(folder) | {
            "use_sim_time": "false",
            "self_calibration": "false",
            "tilt_timeout": TIMEOUTS_S[number // len(DEVICES) % len(TIMEOUTS_S)],
        }
        inclinometer = {"source": self.source, "port": path, "noise_stddev": 0.001, "ascii.resolution": 1e-5}
        self.nodes = {
            "solver": self._start(folder, "starpos_solver", "solver", solver),
            "inclinometer": self._start(folder, "starpos_inclinometer", "inclinometer", inclinometer),
        }
        many = QoSProfile(depth=100)
        self._stars = node.create_publisher(StarArray, f"{self.name}/stars", many)
        self._info = node.create_publisher(CameraInfo, f"{self.name}/camera/camera_info", many)
        node.create_subscription(Tilt, f"{self.name}/tilt", self._on_tilt, QoSProfile(depth=1000))
        for topic in ("fix", "fix_averaged"):
            node.create_subscription(NavSatFix, f"{self.name}/{topic}", self._on_fix, many)

    def _start(self, folder: Path, package: str, name: str, values: dict) -> Executable:
        namespace = ("--ros-args", "-r", f"__ns:=/{self.name}")
        log = folder / f"{self.name}-{name}.log"
        return Executable(log, package, name, namespace, [f"{k}:={v}" for k, v in values.items()])

    # what comes out --------------------------------------------------------------------------------------------------

    def _on_tilt(self, tilt: Tilt):
        self.counts["tilts"] += 1
        if tilt.flags & UNUSABLE:
            self.counts["flagged"] += 1
            return
        from leaning import NOISE_RAD

        at = stamp_to_unix(tilt.header.stamp) - self._unix_s
        off_s = np.linspace(-1, 1, 41) * STAMP_S[self.source]
        true = self._motion.tilt(at + off_s)
        least, most = true.min(0) - TILT_SIGMAS * NOISE_RAD, true.max(0) + TILT_SIGMAS * NOISE_RAD
        if not ((least <= [tilt.x, tilt.y]) & ([tilt.x, tilt.y] <= most)).all():
            self.counts["wrong tilts"] += 1
            off = np.degrees(np.abs([tilt.x, tilt.y] - self._motion.tilt(at))).max()
            self._complain(
                f"a tilt {off:.3f} deg off at its stamp, {at - self._resumed_s:+.2f} s after the resumption"
            )

    def _on_fix(self, fix: NavSatFix):
        from accelerated import Truth

        if fix.status.status < 0:
            self.counts["no fixes"] += 1
            return
        self.counts["fixes"] += 1
        at = stamp_to_unix(fix.header.stamp) - self._unix_s
        self._seen_fix |= at > self._resumed_s
        site = self._next[1].site
        truth = Truth(site.latitude_deg, site.longitude_deg, 0.0)
        covariance = np.reshape(fix.position_covariance, (3, 3))[:2, :2]
        sigmas, text = truth.sigmas_off(fix.latitude, fix.longitude, covariance)
        if not sigmas <= 5.0:
            self.counts["wrong fixes"] += 1
            self._complain(
                f"a fix {sigmas:.0f} sigma off, {text}, {at - self._resumed_s:+.2f} s after the resumption"
            )

    def _complain(self, what: str):
        self.wrong.append(f"WRONG {self.name} ({self.source}): {what}")
        print(self.wrong[-1], file=sys.stderr, flush=True)

    # what goes in ----------------------------------------------------------------------------------------------------

    def expose(self, now_s: float):
        """Send the star lists of the exposures that are over; leave out those that came too late."""
        from starpos_testing.graph.shots import EXPOSURE_S, shot_of

        while self._next[0] + EXPOSURE_S < now_s:
            begin_s, scene = self._next
            if begin_s + EXPOSURE_S > now_s - LATE_S:
                shot = shot_of(scene, begin_s + self._unix_s, self._rng)
                self._info.publish(shot.info)
                self._stars.publish(shot.stars)
            self._next = next(self._exposures)

    def stall(self, now_s: float, more: bool) -> bool:
        """Stop or continue the inclinometer's process when it is time; return whether a stall has begun."""
        if self._stands:
            if now_s >= self._until_s:
                self.nodes["inclinometer"].signal(signal.SIGCONT)
                self._stands, self._until_s, self._resumed_s = False, float("inf"), time.monotonic()
            return False
        if self._seen_fix and self._until_s == float("inf"):
            self._until_s = now_s + self._rng.uniform(0.0, 1.5)
        if not more or now_s < self._until_s:
            return False
        self.nodes["inclinometer"].signal(signal.SIGSTOP)
        self._stands, self._seen_fix = True, False
        self._until_s = now_s + float(np.exp(self._rng.uniform(*np.log(STALL_S))))
        return True

    @property
    def recovered(self) -> bool:
        """Whether a fix of an exposure after the last stall has come."""
        return self._seen_fix and not self._stands

    @property
    def stuck(self) -> bool:
        return not self._stands and not self._seen_fix and time.monotonic() - self._resumed_s > WAIT_S

    def close(self):
        if self._stands:
            self.nodes["inclinometer"].signal(signal.SIGCONT)
        for node in self.nodes.values():
            node.end()
            if "Traceback" in node.output:
                self._complain(f"a defect in the log of {node.name}: {node.output[-2000:]}")
        self.device.terminate()
        self.device.join()


def soaked(stalls: int, instruments: int, seed: int, folder: Path) -> list[Instrument]:
    """Run until each of the instruments has recovered from the last of the stalls; return them."""
    rclpy.init()
    node, executor = rclpy.create_node("stall_soak"), SingleThreadedExecutor()
    executor.add_node(node)
    made: list[Instrument] = []
    try:
        made += [Instrument(node, folder, k, seed) for k in range(instruments)]
        begun = 0
        while begun < stalls or not all(i.recovered for i in made):
            executor.spin_once(timeout_sec=0.01)
            now_s = time.monotonic()
            for i in made:
                i.expose(now_s)
                begun += i.stall(now_s, more=begun < stalls)
                if i.stuck:
                    i.counts["stuck"] += 1
                    return made
    finally:
        for i in made:
            i.close()
        executor.shutdown()
        node.destroy_node()
        rclpy.try_shutdown()
    return made


def options(parser) -> None:
    parser.add_argument("--stalls", type=int, default=200)
    parser.add_argument("--instruments", type=int, default=4, help="at a time")
    parser.add_argument("--seed", type=int, default=seed_of_the_day(), help="default: of the day")


def run(options) -> int:
    take_domain()
    with tempfile.TemporaryDirectory() as folder:
        made = soaked(options.stalls, options.instruments, options.seed, Path(folder))
    counts = sum((i.counts for i in made), Counter())
    names = ("fixes", "wrong fixes", "no fixes", "tilts", "wrong tilts", "flagged", "stuck")
    print(f"{options.stalls} stalls: " + ", ".join(f"{counts[name]} {name}" for name in names))
    return int(any(i.wrong for i in made) or counts["stuck"] > 0)

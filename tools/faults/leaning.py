# SPDX-License-Identifier: Apache-2.0
"""An instrument that leans otherwise every second or two, and its inclinometer on a serial line, for `stall_soak.py`."""

import math
import time
from dataclasses import replace

import numpy as np

from starpos.simulation.scene import Scene
from starpos_testing.emulator import Emulator, Mcu, Pty
from starpos_testing.graph.shots import EXPOSURE_S, SMALL, scene_at

NOISE_RAD = math.radians(0.001)
# Rests between moves, and moves, in s.
REST_S, MOVE_S = (0.8, 2.5), (0.05, 0.5)
POSES = 4000
LINE_PERIOD_S = 0.1


class Motion:
    """Rests and moves from `begin_s` of the monotonic clock on; the same for the same seed, in any process."""

    def __init__(self, seed: int, begin_s: float):
        rng = np.random.default_rng(seed)
        rests, moves = rng.uniform(*REST_S, POSES), rng.uniform(*MOVE_S, POSES)
        self._begin = begin_s + np.concatenate([[0.0], np.cumsum(rests + moves)[:-1]])
        self._end = self._begin + rests
        self._pointings = np.column_stack([rng.uniform(0, 360, POSES), rng.uniform(76, 84, POSES)])
        tilts = np.array([self.scene(k).tilt for k in range(POSES)])
        self._times = np.column_stack([self._begin, self._end]).ravel()
        self._tilts = np.repeat(tilts, 2, axis=0)

    def scene(self, pose: int) -> Scene:
        azimuth_deg, altitude_deg = self._pointings[pose]
        return replace(scene_at(size=SMALL), azimuth_deg=azimuth_deg, altitude_deg=altitude_deg)

    def tilt(self, at_s) -> np.ndarray:
        """True theta_x, theta_y (..., 2) in rad."""
        return np.stack([np.interp(at_s, self._times, self._tilts[:, k]) for k in range(2)], -1)

    def exposures(self, rng: np.random.Generator):
        """Yield (begin_s, scene) of exposures during the rests, some just after a move."""
        for pose in range(POSES):
            begin_s = self._begin[pose] + rng.uniform(0, 0.3) * (rng.random() < 0.7)
            while begin_s + EXPOSURE_S < self._end[pose]:
                yield begin_s, self.scene(pose)
                begin_s += EXPOSURE_S + rng.uniform(0.05, 0.5)


def serve_mcu(path: str, seed: int, begin_s: float):
    """Be the microcontroller, whose samples have times of its own clock, until this process is ended."""
    motion = Motion(seed, begin_s)
    mcu = Mcu(lambda now: motion.tilt(now).tolist(), NOISE_RAD, drift_ppm=3000.0, seed=seed)
    Emulator(mcu, path).run(lambda: False)


def serve_lines(path: str, seed: int, begin_s: float):
    """Be a tiltmeter without a clock that sends a line as it measures, until this process is ended."""
    motion, pty, rng = Motion(seed, begin_s), Pty(path), np.random.default_rng(seed)
    due = time.monotonic()
    while True:
        due = max(due + LINE_PERIOD_S, time.monotonic() - 1.0)
        time.sleep(max(due - time.monotonic(), 0.0))
        x, y = np.degrees(motion.tilt(time.monotonic()) + rng.normal(0, NOISE_RAD, 2))
        pty.write(f"{x:.5f},{y:.5f}\r\n".encode())


DEVICES = {"serial": serve_mcu, "ascii": serve_lines}

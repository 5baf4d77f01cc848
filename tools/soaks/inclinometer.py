# SPDX-License-Identifier: Apache-2.0
"""Half an hour of the inclinometer's driver on a pseudo-terminal, accelerated, with faults: whether its memory grows.

One line in twenty is damaged, the microcontroller is reset every 5 minutes, the cable pulled every 7.  Exit status 1 if
the resident memory of the last half has grown by more than 1 MB against the half before, or too few samples came.
"""

import random
import tempfile
import threading
import time
from pathlib import Path

from runner import Memory, Progress

from starpos.parameters.table import defaults_of
from starpos_inclinometer.clock import HostClock
from starpos_inclinometer.sources.mcu import McuSource
from starpos_inclinometer.sources.source import Surroundings
from starpos_testing.emulator import Faults, Mcu, Pty

RATE_HZ, ALLOWED_MB, ENOUGH = 50, 1.0, 0.6
RESET_S, PULL_S, PULLED_S = 300.0, 420.0, 20.0
FAULTS = Faults(garbage=0.02, drop=0.01, truncate=0.01, double=0.01, flip=0.00003)


class Device(threading.Thread):
    """Emulated microcontroller on a fast clock; its cable is pulled now and then."""

    def __init__(self, path: str, now_s, stop: threading.Event):
        super().__init__(daemon=True)
        self._path, self._now_s, self._stop_event = path, now_s, stop
        self._mcu = Mcu(lambda now: (0.1, -0.2), rate_hz=RATE_HZ, seed=1)

    def run(self):
        mcu, rng, port = self._mcu, random.Random(1), Pty(self._path)
        port.write(mcu.reset(self._now_s()))
        next_reset, next_pull, back = RESET_S, PULL_S, 0.0
        while not self._stop_event.wait(1e-3):
            now = self._now_s()
            if port and now >= next_pull:
                port.close()
                port, back, next_pull = None, now + PULLED_S, next_pull + PULL_S
            if not port and now >= back:
                port = Pty(self._path)
            said = b""
            if now >= next_reset:
                said, next_reset = mcu.reset(now), next_reset + RESET_S
            while mcu.due <= now:
                said += FAULTS.apply(mcu.sample(), rng)
            if port:
                port.write(said)
                port.write(mcu.receive(port.read()))
        if port:
            port.close()


def options(parser) -> None:
    parser.add_argument("--samples", type=int, default=90_000, help=f"90000, at {RATE_HZ} Hz")
    parser.add_argument("--speed", type=float, default=60.0, help="times as fast as real time (60)")


def run(options) -> int:
    samples, speed, begin_ns = options.samples, options.speed, time.monotonic_ns()

    def fast_ns() -> int:
        return round((time.monotonic_ns() - begin_ns) * speed)

    values = defaults_of("inclinometer") | {"rate": RATE_HZ}
    stop, woken, progress, got = threading.Event(), threading.Event(), Progress(samples, "samples due"), 0
    with tempfile.TemporaryDirectory() as folder:
        values["port"] = str(Path(folder) / "port")
        device = Device(values["port"], lambda: fast_ns() * 1e-9, stop)
        clock = HostClock(lambda: 1_700_000_000 * 10**9 + fast_ns(), monotonic_ns=fast_ns)
        source = McuSource(Surroundings(None, clock, woken.set), values)
        device.start()
        source.start()
        due, memory = 0, Memory()
        while due < samples:
            woken.wait(0.1)
            woken.clear()
            got += len(source.fetch())
            due = round(fast_ns() * 1e-9 * RATE_HZ)
            if due < samples / 10:
                memory = Memory()
            memory.look()
            progress.at(due, got, "came,", memory)
        health = source.health()
        stop.set()
        device.join()
        source.stop()
    print(health.counts, {k: health.values[k] for k in ("openings", "unfetched samples")})
    print(f"{got} of {samples} samples; the last half's memory {memory.grown:+.2f} MB")
    return int(memory.grown > ALLOWED_MB or got < ENOUGH * samples)

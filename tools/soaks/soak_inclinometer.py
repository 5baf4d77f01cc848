# SPDX-License-Identifier: Apache-2.0
"""Half an hour of the inclinometer's driver on a pseudo-terminal, accelerated, with faults: its memory at each tenth.

    python tools/soaks/soak_inclinometer.py [SAMPLES] [SPEED]          90000 at 50 Hz, 60 times as fast

One line in twenty is damaged, the microcontroller is reset every 5 minutes, the cable pulled every 7. Exit status 0; 1 if
the resident memory of the last half has grown by more than 1 MB against the half before, or too few samples came.
"""

import random
import sys
import tempfile
import threading
import time
from pathlib import Path

from starpos_inclinometer.emulator import Faults, Mcu, Pty
from starpos_inclinometer.host_clock import HostClock
from starpos_inclinometer.parameters import PARAMETERS
from starpos_inclinometer.sources.mcu import McuSource
from starpos_inclinometer.sources.source import Surroundings
from starpos_testing.processes import memory_mb

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


def main() -> int:
    samples = int(sys.argv[1]) if len(sys.argv) > 1 else 90_000
    speed = float(sys.argv[2]) if len(sys.argv) > 2 else 60.0
    begin_ns = time.monotonic_ns()

    def fast_ns() -> int:
        return round((time.monotonic_ns() - begin_ns) * speed)

    values = {p.name: p.default for p in PARAMETERS} | {"rate": RATE_HZ}
    stop, woken, sizes, got = threading.Event(), threading.Event(), [], 0
    with tempfile.TemporaryDirectory() as folder:
        values["port"] = str(Path(folder) / "port")
        device = Device(values["port"], lambda: fast_ns() * 1e-9, stop)
        clock = HostClock(lambda: 1_700_000_000 * 10**9 + fast_ns(), monotonic_ns=fast_ns)
        source = McuSource(Surroundings(None, clock, woken.set), values)
        device.start()
        source.start()
        tenths = [samples / RATE_HZ * k / 10 for k in range(1, 11)]
        while tenths:
            woken.wait(0.1)
            woken.clear()
            got += len(source.take())
            sizes.append(memory_mb())
            if fast_ns() * 1e-9 >= tenths[0]:
                print(f"{tenths.pop(0):7.0f} s  {got:6d} samples  {sizes[-1]:7.2f} MB", flush=True)
        health = source.health()
        stop.set()
        device.join()
        source.stop()
    warm = sizes[len(sizes) // 10 :]
    half = len(warm) // 2
    grown = max(warm[half:]) - max(warm[:half])
    print(health.counts, {k: health.values[k] for k in ("openings", "unfetched samples")})
    print(f"{got} of {samples} samples; the last half's memory {grown:+.2f} MB against the first's")
    return int(grown > ALLOWED_MB or got < ENOUGH * samples)


if __name__ == "__main__":
    sys.exit(main())

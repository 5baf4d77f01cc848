# SPDX-License-Identifier: Apache-2.0
"""Steps of the host's clock are seen, slewing and simulations are not taken for such."""

import time

import pytest

from starpos_inclinometer.clock import TRIES, HostClock


class Host:
    """A clock that can be set."""

    def __init__(self):
        self.ahead_s = 0.0

    def __call__(self):
        return time.monotonic_ns() + round(self.ahead_s * 1e9)


@pytest.mark.parametrize("step_s", [2.0, -2.0, 0.15, 3600.0])
def test_a_step_is_seen_and_measured(step_s):
    host = Host()
    clock = HostClock(host)
    before = clock.read()
    host.ahead_s = step_s
    after = clock.read()
    assert clock.step.seconds == pytest.approx(step_s, abs=0.01)
    assert after.host_ns * 1e-9 - after.monotonic_s == pytest.approx(step_s, abs=0.01)
    seen = clock.step
    clock.read()
    assert clock.step is seen and after.monotonic_s >= before.monotonic_s


def test_slewing_is_no_step():
    host = Host()
    clock = HostClock(host)
    for _ in range(100):
        host.ahead_s += 0.05
        clock.read()
    assert clock.step is None


def test_a_simulations_clock_is_not_judged():
    host, simulated = Host(), [True]
    clock = HostClock(host, lambda: simulated[0])
    for _ in range(5):
        host.ahead_s += 100.0
        clock.read()
    simulated[0] = False
    clock.read()
    assert clock.step is None


def test_a_reading_that_was_interrupted_is_taken_again():
    """The process was suspended between the two clocks: that is no step, and no wrong stamp."""
    pauses = [0.15, 0.0]

    def now_ns():
        end = time.monotonic() + (pauses.pop(0) if pauses else 0.0)
        while time.monotonic() < end:
            pass
        return time.monotonic_ns()

    clock = HostClock(now_ns)
    moment = clock.read()
    assert abs(moment.host_ns * 1e-9 - moment.monotonic_s) < 0.01
    pauses[:] = [0.2] * TRIES
    for _ in range(2):
        clock.read()
    assert clock.step is None
    first = HostClock(now_ns)
    pauses[:] = [0.2] * TRIES
    for _ in range(2):
        first.read()
    assert first.step is None

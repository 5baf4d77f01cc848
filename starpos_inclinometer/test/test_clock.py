# SPDX-License-Identifier: Apache-2.0
"""The filter against lines with jitter, drift, stalls, wraps and resets, whose true delays are known."""

import numpy as np
import pytest

from starpos_inclinometer.clock import ArrivalFilter

LATENCY_S = 0.031


def stamps(ms, arrivals, clock=None):
    clock = clock or ArrivalFilter()
    late = np.array([clock.delay(int(m), float(a)) for m, a in zip(ms, arrivals, strict=True)])
    return np.asarray(arrivals) - late - LATENCY_S, clock


def jittery(rng, n, rate_hz=10.0, drift_ppm=0.0, boot_ms=0):
    """True times of n samples, the MCU's milliseconds, and arrivals: mostly quick, sometimes very late."""
    true = 1000.0 + np.arange(n) / rate_hz
    ms = (boot_ms + np.floor((true - 1000.0) * 1e3 * (1 + drift_ppm * 1e-6))).astype(np.int64) % 2**32
    late = rng.exponential(0.003, n) + (rng.random(n) < 0.02) * rng.exponential(0.2, n).clip(0, 1)
    # Bytes arrive in order.
    return true, ms, np.maximum.accumulate(true + LATENCY_S + late)


@pytest.mark.parametrize("drift_ppm", [0, 100, -100, 10_000, -10_000])
def test_jitter_is_filtered_whatever_the_drift(drift_ppm):
    true, ms, arrivals = jittery(np.random.default_rng(3), 3000, drift_ppm=drift_ppm)
    estimate, clock = stamps(ms, arrivals)
    error = (estimate - true)[600:]
    assert np.abs(error).max() < 0.005
    assert np.abs(arrivals - true - LATENCY_S)[600:].max() > 0.2
    assert clock.restarts == 0
    assert clock.rate_ppm == pytest.approx(-drift_ppm, abs=max(60, 0.011 * abs(drift_ppm)))


def test_the_wrap_of_the_milliseconds_is_not_seen():
    true, ms, arrivals = jittery(np.random.default_rng(4), 1200, boot_ms=2**32 - 60_000)
    assert ms.max() > 2**32 - 200 and ms.min() < 200
    estimate, clock = stamps(ms, arrivals)
    assert clock.restarts == 0
    assert np.abs(estimate - true)[300:].max() < 0.005


def test_a_reset_starts_anew():
    rng = np.random.default_rng(5)
    true, ms, arrivals = jittery(rng, 600)
    clock = stamps(ms, arrivals)[1]
    estimate, clock = stamps(ms, arrivals + 61.5, clock)
    assert clock.restarts == 1
    assert np.abs(estimate - true - 61.5)[50:].max() < 0.006


def test_a_reset_nobody_saw_starts_anew():
    """The MCU was reset while the cable was out, and its clock is ahead, but not enough."""
    clock = ArrivalFilter()
    for i in range(50):
        clock.delay(100 * i, 10 + 0.1 * i)
    assert clock.delay(9000, 75.0) == 0.0
    assert clock.restarts == 1


def test_a_stall_makes_lateness_not_another_clock():
    true, ms, arrivals = jittery(np.random.default_rng(6), 900)
    stalled = arrivals.copy()
    stalled[500:515] = arrivals[515]
    estimate, clock = stamps(ms, stalled)
    assert clock.restarts == 0
    assert np.abs(estimate - true)[300:].max() < 0.005


def test_delays_are_never_negative_and_never_raise():
    rng = np.random.default_rng(7)
    clock = ArrivalFilter()
    for ms, arrival in zip(rng.integers(0, 2**32, 5000), np.cumsum(rng.random(5000)), strict=True):
        assert clock.delay(int(ms), float(arrival)) >= 0.0

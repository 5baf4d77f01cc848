# SPDX-License-Identifier: Apache-2.0
"""The filter against lines with jitter, drift, stalls, wraps and resets, whose true delays are known."""

import numpy as np
import pytest

from starpos_inclinometer.clock import ArrivalFilter, PaceWatch

LATENCY_S = 0.031


class Watched(ArrivalFilter):
    """A filter that counts how often it starts again; its first sample makes it 0."""

    restarts = -1

    def _start(self, *sample):
        self.restarts += 1
        super()._start(*sample)


def stamps(ms, arrivals, clock=None):
    clock = clock or Watched()
    late = [clock.delay(int(m), float(a)) for m, a in zip(ms, arrivals, strict=True)]
    # NaN where it is not known.
    return np.asarray(arrivals) - np.array(late, float) - LATENCY_S, clock


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
    assert np.isnan(estimate).sum() < 40
    assert np.abs(error).max() < 0.005
    assert np.abs(arrivals - true - LATENCY_S)[600:].max() > 0.2
    assert clock.restarts == 0
    assert clock.rate_ppm == pytest.approx(-drift_ppm, abs=max(60, 0.011 * abs(drift_ppm)))


@pytest.mark.parametrize("seed", range(0, 40, 4))
def test_a_stall_on_a_busy_machine_does_not_spoil_the_rate(seed):
    """The first samples after a stall come late: no rate is fitted to them."""
    errors_s = []
    for stall in range(seed, seed + 4):
        rng = np.random.default_rng(stall)
        before_s, stall_s = rng.uniform(4, 30), rng.uniform(0.5, 10)
        true = 1000.0 + np.arange(0, before_s + stall_s + 5, 0.1)
        # The busy reader reads at random times, and not at all while it stands still.
        reads = 1000.0 + np.cumsum(rng.exponential(0.1, 2000))
        reads = reads[(reads < 1000.0 + before_s) | (reads > 1000.0 + before_s + stall_s)]
        arrivals = reads[np.searchsorted(reads, true)] + LATENCY_S
        ms = np.round((true - 1000.0) * 1e3 * (1 - 3e-3)).astype(int)
        errors_s.append(np.abs(stamps(ms, arrivals)[0] - true))
    assert np.nanmax(np.concatenate(errors_s)) < 0.1


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
    assert np.isnan(estimate[:10]).all() and np.isnan(estimate).sum() < 40
    assert np.abs(estimate - true - 61.5)[50:].max() < 0.006


def test_a_clock_that_stood_still_is_noticed_once_samples_come_at_their_pace_again():
    """The MCU was reset while the cable was out and its clock is ahead, but not enough; or it stood still."""
    clock = Watched()
    for i in range(50):
        clock.delay(100 * i, 10 + 0.1 * i)
    told = [clock.delay(9000 + 100 * i, 75 + 0.1 * i) for i in range(20)]
    assert clock.restarts == 1
    assert told[:10] == [None] * 10
    assert told[11:] == pytest.approx([0.0] * 9, abs=1e-6)


@pytest.mark.parametrize("rate_hz", [5.0, 10.0, 50.0])
@pytest.mark.parametrize("stall_s", [0.5, 1.5, 2.5, 4.0, 10.0, 40.0])
def test_a_backlog_keeps_the_times_it_was_sampled_at(stall_s, rate_hz):
    """The process stands still: 17 of 16 such stalls gave a wrong fix when a backlog was taken for a reset."""
    true, ms, arrivals = jittery(np.random.default_rng(8), int(100 * rate_hz), rate_hz)
    stalled = np.maximum(arrivals, np.where((true > 1030) & (true < 1030 + stall_s), 1030 + stall_s, 0))
    # Reading takes its time.
    stalled[1:] += 2e-5 * np.cumsum(np.diff(stalled) <= 0)
    estimate, clock = stamps(ms, np.maximum.accumulate(stalled))
    error = np.abs(estimate - true)
    assert clock.restarts == 0
    assert np.nanmax(error[int(10 * rate_hz) :]) < (0.03 if stall_s < 30 else 0.1)
    assert np.isnan(error[int(10 * rate_hz) :]).sum() < 5


def read_by_a_process_that_stands(true, stalls):
    """When lines are read: all that are there, whenever the process runs; stalls: (begin, end) of each."""
    read = true + LATENCY_S
    for begin, end in stalls:
        read[(read >= begin) & (read < end)] = end
    return read


STANDS_AGAIN = [(1020, 1024), (1024.01, 1028), (1028.02, 1031), (1031.3, 1035)]


@pytest.mark.parametrize("rate_hz", [5.0, 10.0, 50.0])
def test_a_process_that_stands_again_while_it_reads_its_backlog_dates_it_rightly(rate_hz):
    """Two seconds of backlog, read in two parts, looked like a device's clock that had stood still."""
    true = 1000 + np.arange(int(60 * rate_hz)) / rate_hz
    ms = np.round((true - 1000) * 1e3)
    read = read_by_a_process_that_stands(true, STANDS_AGAIN)
    # of the backlog one part is read before the process stands again, one after
    part = (true > 1020) & (true < 1022)
    read[part] = 1024.0
    read[(true >= 1022) & (true < 1024)] = 1028.0
    estimate, clock = stamps(ms, read)
    assert clock.restarts == 0
    assert np.nanmax(np.abs(estimate - true)[int(10 * rate_hz) :]) < 0.02


def test_a_reset_within_a_stall_is_not_dated_before_the_clocks_have_kept_their_relation():
    clock = Watched()
    for i in range(150):
        clock.delay(100 * i, 10 + 0.1 * i)
    # Booted at 25, read at 30.
    backlog = [clock.delay(100 * i, 30.0 + 1e-4 * i) for i in range(50)]
    assert backlog == [None] * 50
    live = [clock.delay(5000 + 100 * i, 30.1 + 0.1 * i) for i in range(20)]
    assert None in live[:10] and live[11:] == pytest.approx([0.0] * 9, abs=0.01)


def test_lines_without_a_clock_are_not_dated_after_a_silence_until_they_come_at_their_pace():
    watch = PaceWatch()
    assert all(watch.on_time(10 + 0.1 * i) for i in range(50))
    backlog = [watch.on_time(18.0 + 1e-4 * i) for i in range(31)]
    assert backlog == [False] * 31
    live = [watch.on_time(18.1 + 0.1 * i) for i in range(20)]
    assert live[3:] == [True] * 17
    assert [watch.on_time(25.0 + 0.1 * i) for i in range(6)] == [False] * 4 + [True] * 2


@pytest.mark.parametrize("rate_hz", [10.0, 50.0])
def test_lines_without_a_clock_are_not_dated_by_a_process_that_stands_again_or_reads_slowly(rate_hz):
    true = 1000 + np.arange(int(60 * rate_hz)) / rate_hz
    read = read_by_a_process_that_stands(true, STANDS_AGAIN)
    # a pause between two reads of one backlog, about as long as from line to line
    read[(true > 1033) & (read == 1035)] += 0.9 / rate_hz
    watch = PaceWatch()
    told = np.array([watch.on_time(t) for t in np.maximum.accumulate(read)])
    assert (read - true - LATENCY_S)[told].max() < 2 / rate_hz
    assert told[true < 1019.9].all() and told[true > 1037].all()


def test_lines_that_come_in_bursts_do_not_make_a_backlog_look_like_lines_on_time():
    watch = PaceWatch()
    for t in np.repeat(np.arange(0, 6, 0.06), 3):
        watch.on_time(t)
    assert not any(watch.on_time(12.0 + 1e-4 * i) for i in range(300))


def test_slow_and_uneven_lines_are_on_time():
    rng = np.random.default_rng(9)
    slow, chunked = PaceWatch(), PaceWatch()
    assert all(slow.on_time(t) for t in np.cumsum(1 + 0.05 * rng.normal(size=50)))
    # Two lines at a time, as some adapters hand them over.
    arrivals = np.repeat(np.arange(0, 4, 0.04), 2)
    assert all(chunked.on_time(t) for t in arrivals)


def test_a_stall_makes_lateness_not_another_clock():
    true, ms, arrivals = jittery(np.random.default_rng(6), 900)
    stalled = arrivals.copy()
    stalled[500:515] = arrivals[515]
    estimate, clock = stamps(ms, stalled)
    assert clock.restarts == 0
    assert np.abs(estimate - true)[300:].max() < 0.005


def test_delays_are_never_negative_and_never_raise():
    rng = np.random.default_rng(7)
    clock = Watched()
    for ms, arrival in zip(rng.integers(0, 2**32, 5000), np.cumsum(rng.random(5000)), strict=True):
        delay = clock.delay(int(ms), float(arrival))
        assert delay is None or delay >= 0.0

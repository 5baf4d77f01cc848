# SPDX-License-Identifier: Apache-2.0
"""The noise that is found in samples, and whether the covariances made of it hold: `pull` is error over claim."""

import math

import numpy as np
import pytest
from board import Board

from starpos.instrument.tilt_log import LONG_RUN, SHORT_RUN, NoiseTracker
from starpos.parameters.table import defaults_of
from starpos_inclinometer.sources import mcu_protocol
from starpos_inclinometer.sources.tilts import Sca100t
from starpos_testing.emulator import Mcu

SIGMA = math.radians(0.0035)


def tracked(values, rate_hz, tracker=None, begin_s=0.0):
    """A tracker after (N, 2) samples."""
    tracker = tracker or NoiseTracker()
    for k, (x, y) in enumerate(values.tolist()):
        tracker.add_sample(begin_s + k / rate_hz, x, y)
    return tracker


def white(n, sigma=SIGMA, seed=1):
    return sigma * np.random.default_rng(seed).standard_normal((n, 2))


def measured(samples):
    """(N, 2) tilts and (N, 2) 1 sigma of them, once the noise is known."""
    sensor = Sca100t(defaults_of("inclinometer"))
    got = [(sensor.measure(s, s.milliseconds * 1e-3), sensor.noise.sigma) for s in samples]
    known = [m for m, sigma in got if sigma is not None]
    return np.array([(m.x, m.y) for m in known]), np.sqrt([m.covariance[::3] for m in known])


def pull_of_means(tilts, sigmas, n):
    """Scatter, over claim, of means of n samples, as who uses tilts makes them."""
    whole = len(tilts) // n * n
    means = tilts[:whole].reshape(-1, n, 2).mean(1)
    claims = np.sqrt((sigmas[:whole] ** 2).reshape(-1, n, 2).mean(1) / n)
    return ((means - tilts.mean(0)) / claims).std()


@pytest.mark.parametrize("rate_hz", [1, 10, 50])
@pytest.mark.parametrize("noise_deg", [0.001, 0.0035, 0.02])
def test_claims_hold_at_every_rate_and_noise(rate_hz, noise_deg):
    mcu = Mcu(lambda now: (0.1, -0.2), math.radians(noise_deg), rate_hz=rate_hz, seed=rate_hz)
    mcu.reset(0.0)
    tilts, sigmas = measured(mcu_protocol.LineParser().parse(b"".join(mcu.sample() for _ in range(3000))))
    assert ((tilts - tilts.mean(0)) / sigmas).std() == pytest.approx(1, abs=0.1)
    assert pull_of_means(tilts, sigmas, max(rate_hz, 5)) == pytest.approx(1, abs=0.15)
    assert np.degrees(sigmas).mean() == pytest.approx(noise_deg, rel=0.12)


@pytest.mark.parametrize(("rate_hz", "seconds"), [(1, 250), (50, 60)])
def test_claims_hold_on_the_firmware(built, rate_hz, seconds):
    """Whose sensor has a bandwidth of 18 Hz: at 50 Hz a mean of n is not as good as one of n independent samples."""
    board = Board(built)
    board.connect()
    board.run(1000)
    board.messages(50, mcu_protocol.rate_command(rate_hz))
    tilts, sigmas = measured(m for m in board.messages(1000 * seconds) if isinstance(m, mcu_protocol.Sample))
    assert board.close() == ""
    assert pull_of_means(tilts, sigmas, max(rate_hz, 2)) == pytest.approx(1, abs=0.2)
    assert 0.8 < ((tilts - tilts.mean(0)) / sigmas).std() < 1.15


def test_neighbours_that_are_alike_are_not_taken_for_independent():
    """A Gauss-Markov process of 18 Hz at 200 Hz: a mean of n scatters as one of white noise of 1.9 times its sigma."""
    kept = math.exp(-2 * math.pi * 18 / 200)
    steps = white(100_000)
    noise = np.empty_like(steps)
    value = steps[0]
    for k, step in enumerate(steps):
        noise[k] = value = kept * value + math.sqrt(1 - kept**2) * step
    found = np.mean([tracked(part, 200).sigma for part in np.split(noise, 20)], axis=0)
    assert found / SIGMA == pytest.approx([math.sqrt((1 + kept) / (1 - kept))] * 2, rel=0.12)


def test_leaps_and_outliers_do_not_count():
    noise = white(300)
    noise[::40] += 0.1
    noise[100:] += 0.05
    noise[250:] -= 0.2
    assert tracked(noise, 10).sigma == pytest.approx([SIGMA] * 2, rel=0.25)


@pytest.mark.parametrize(("step", "expected"), [(SIGMA, 1.04), (2 * SIGMA, 1.15), (20 * SIGMA, 0.0)])
def test_coarse_samples(step, expected):
    """Readings that all stand on one step show no noise; what rounding leaves is the quantisation's to claim."""
    values = np.round((white(400) + 0.2 * step) / step) * step
    found = np.array(tracked(values, 10).sigma) / SIGMA
    assert found == pytest.approx([expected] * 2, abs=0.3)


def test_noise_that_grows_is_noticed_within_three_seconds_and_forgotten_within_twenty():
    tracker = tracked(white(2 * LONG_RUN), 10)
    tracked(white(SHORT_RUN, 4 * SIGMA, seed=2), 10, tracker, begin_s=2 * LONG_RUN / 10)
    assert tracker.sigma == pytest.approx([4 * SIGMA] * 2, rel=0.4)
    tracked(white(LONG_RUN + 1, seed=3), 10, tracker, begin_s=100.0)
    assert tracker.sigma == pytest.approx([SIGMA] * 2, rel=0.2)


def test_axes_have_their_own():
    assert tracked(white(300) * [1.0, 5.0], 10).sigma == pytest.approx([SIGMA, 5 * SIGMA], rel=0.2)


def test_few_samples_an_interruption_and_another_rate_tell_nothing():
    tracker = tracked(white(20), 10)
    assert tracker.sigma is None
    tracked(white(2, seed=2), 10, tracker, begin_s=2.0)
    assert tracker.sigma is not None
    tracker.restart()
    for k, (x, y) in enumerate(white(200).tolist()):
        tracker.interrupt()
        tracker.add_sample(k / 10, x + k, y)
    assert tracker.sigma is None
    # Each 5 s: what they differ by is drift.
    assert tracked(white(100), 0.2).sigma is None

# SPDX-License-Identifier: Apache-2.0
"""Pulses of a shutter and frames: none is paired wrongly, whatever a contact, a cable or a flash does."""

import numpy as np
import pytest

from starpos_common.shutter_pulses import LEARNED, Edge, ShutterPulse, ShutterPulses

BEGIN_S = 1.7e9


class Camera:
    """A camera that is commanded at a cadence, with a contact and faults of it."""

    def __init__(self, seed, exposure_s=0.2, lag_s=0.3, jitter_s=0.004, length_s=None):
        self.rng = np.random.default_rng(seed)
        self.pulses = ShutterPulses()
        self.exposure_s, self.lag_s, self.jitter_s = exposure_s, lag_s, jitter_s
        self.length_s = exposure_s if length_s is None else length_s
        self.sequence = 0

    def edge(self, time_s, rising, lost=False):
        if not lost:
            edge = Edge(time_s=time_s, stddev_s=2e-5, rising=rising, sequence=self.sequence, disciplined=True)
            self.pulses.record(edge)
        self.sequence += 1

    def frame(self, commanded_s, faults=()):
        """The frame's pulse and the faults' pulses, in the order of time; the frame's pair, and its begin."""
        rng = self.rng
        true_s = commanded_s + self.lag_s + rng.normal(0, self.jitter_s)
        arrived_s = true_s + self.exposure_s + rng.uniform(0.03, 0.1)
        pulses = [] if "missed" in faults else [(true_s, self.length_s + rng.normal(0, 2e-5))]
        if "double" in faults:
            pulses.append((true_s + self.length_s + rng.uniform(0.005, 0.02), rng.uniform(0.001, 0.01)))
        if "bouncing" in faults:
            # longer than the 2 ms that the board bridges: the contact opens and closes once more
            at, length = pulses.pop(0) if pulses else (true_s, self.length_s)
            shut, apart = rng.uniform(0.0001, 0.004), rng.uniform(0.002, 0.006)
            pulses += [(at, shut), (at + shut + apart, length - shut - apart)]
        if "spark" in faults:
            pulses.append((rng.uniform(commanded_s, arrived_s), 10 ** rng.uniform(-5, -1)))
        if "flash" in faults:
            # somebody fires by hand
            length_s = self.length_s if "same" in faults else rng.uniform(0.02, 3) * self.length_s
            pulses.append((rng.uniform(commanded_s, arrived_s), length_s))
        edges = sorted(e for at, length in pulses for e in ((at, False), (at + length, True)))
        # a contact that is closed already does not close again
        closed = 0
        for at, rising in edges:
            closed += -1 if rising else 1
            if closed == (0 if rising else 1):
                self.edge(at, rising, lost="lost" in faults and rng.random() < 0.5)
        paired = self.pulses.pair(commanded_s, self.exposure_s, commanded_s, arrived_s)
        return paired, true_s


def test_of_ten_thousand_frames_with_faulty_pulses_none_is_paired_wrongly():
    """Frames twice a second; one in four has one fault or more, of which a third hide the frame's own pulse."""
    wrong, paired, good = 0, 0, 0
    for seed in range(4):
        camera = Camera(seed, lag_s=(0.05, 0.2, 0.0, 0.15)[seed], jitter_s=(0.001, 0.004, 0.0, 0.008)[seed])
        for k in range(2500):
            kinds = ("missed", "double", "bouncing", "spark", "flash", "lost")
            faults = [f for f in kinds if camera.rng.random() < 0.045]
            got, true_s = camera.frame(BEGIN_S + 0.5 * k, faults)
            good += not faults
            if isinstance(got, ShutterPulse):
                paired += 1
                wrong += abs(got.begin_s - true_s) > 1e-4
    assert wrong == 0
    # and of the sound ones nearly all are, after the first
    assert paired > 0.97 * good


def test_a_flash_fired_by_hand_where_the_own_pulse_is_missed_is_not_taken():
    """Fires as long as the frames' own pulse, the worst there is: only its lag differs."""
    camera = Camera(5, jitter_s=0.0005)
    for k in range(50):
        camera.frame(BEGIN_S + k)
    for k in range(50, 2000):
        got, true_s = camera.frame(BEGIN_S + k, ("missed", "flash", "same"))
        if isinstance(got, ShutterPulse):
            # the frame's own time, to the scatter that its lag has always had
            assert abs(got.begin_s - true_s) < 0.007
        camera.frame(BEGIN_S + k + 0.5)


def test_the_lag_of_the_camera_is_measured():
    camera = Camera(1, lag_s=0.3, jitter_s=0.004)
    results = [camera.frame(BEGIN_S + 2 * k)[0] for k in range(40)]
    assert [isinstance(r, str) for r in results[:LEARNED]] == [True] * LEARNED
    assert all(isinstance(r, ShutterPulse) for r in results[LEARNED + 5 :])
    lag = camera.pulses.lag
    assert lag.median_s == pytest.approx(0.3, abs=0.003) and lag.stddev_s == pytest.approx(0.004, rel=0.5)


def test_a_camera_whose_lag_scatters_is_hardly_paired_and_has_no_lag():
    camera = Camera(2, lag_s=0.6, jitter_s=0.2)
    results = [camera.frame(BEGIN_S + 4 * k) for k in range(200)]
    pairs = [(got, true_s) for got, true_s in results if isinstance(got, ShutterPulse)]
    assert all(abs(got.begin_s - true_s) < 1e-4 for got, true_s in pairs) and len(pairs) < 20
    assert camera.pulses.lag is None


def test_another_exposure_is_learned_anew():
    camera = Camera(3)
    for k in range(20):
        camera.frame(BEGIN_S + 2 * k)
    camera.exposure_s = camera.length_s = 0.5
    results = [camera.frame(BEGIN_S + 100 + 2 * k)[0] for k in range(20)]
    assert all(isinstance(r, str) for r in results[:LEARNED])
    assert isinstance(results[-1], ShutterPulse)


@pytest.mark.parametrize(
    ("faults", "said"), [(("missed",), "no pulse"), (("double",), "2 pulses"), (("lost",), "lost near it")]
)
def test_a_frame_without_a_pulse_says_why(faults, said):
    camera = Camera(4)
    for k in range(20):
        camera.frame(BEGIN_S + 2 * k)
    said_of = set()
    for k in range(20, 40):
        got, _ = camera.frame(BEGIN_S + 2 * k, faults)
        if isinstance(got, str):
            said_of.add(got)
        camera.frame(BEGIN_S + 2 * k + 1)
    assert any(said in reason for reason in said_of)

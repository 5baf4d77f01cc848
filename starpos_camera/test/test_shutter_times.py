# SPDX-License-Identifier: Apache-2.0
"""Times of frames by the pulses of their shutter: whose they are, how far they may be off, what stands without one."""

import math
import threading

import numpy as np
import pytest

from starpos.frames.frame import Frame
from starpos.parameters.table import defaults_of
from starpos_camera.sources.source import CapturedFrame
from starpos_camera.sources.timing import ENOUGH_FOR_LAG, ShutterTimes
from starpos_common.messages import unix_to_stamp
from starpos_interfaces.msg import Capture, Pulse
from starpos_testing.patience import WAIT_S

BEGIN_S, EXPOSURE_S = 1.7e9, 0.5
VALUES = defaults_of("camera") | {"pulses": True, "command_lag": 0.1, "driver_lag": 0.2}
PIXELS = np.zeros((16, 16), np.uint8)


class Reflex:
    """A camera with an unstated lag of 0.3 s; the parameters say 0.1 s."""

    def __init__(self, patience_s=0.0, **values):
        self.times = ShutterTimes(VALUES | values, patience_s)
        self.rng = np.random.default_rng(1)
        self.sequence = 0

    def edge(self, time_s, rising, disciplined=True):
        pulse = Pulse(input=Pulse.SHUTTER, rising=rising, sequence=self.sequence, disciplined=disciplined)
        pulse.header.stamp, pulse.stamp_stddev = unix_to_stamp(time_s), 2e-5
        self.sequence += 1
        self.times.hear(pulse)

    def frame(self, k, pulse=True, source=Capture.COMMAND, disciplined=True):
        """The frame as it comes out, and the middle of its exposure."""
        told_s = BEGIN_S + 2 * k
        begin_s = told_s + 0.3 + self.rng.normal(0, 0.003)
        if pulse:
            self.edge(begin_s, False, disciplined)
            self.edge(begin_s + EXPOSURE_S, True, disciplined)
        stated_s = VALUES["driver_lag" if source == Capture.DRIVER else "command_lag"]
        frame = Frame(
            mid_unix_s=told_s + stated_s + EXPOSURE_S / 2,
            exposure_s=EXPOSURE_S,
            stamp_stddev_s=0.3,
            pixels=PIXELS,
        )
        got = self.times.date_frame(CapturedFrame(frame, source), told_s, begin_s + EXPOSURE_S + 0.1)
        return got, begin_s + EXPOSURE_S / 2


@pytest.mark.parametrize("source", [Capture.COMMAND, Capture.DRIVER])
def test_a_frame_has_the_time_of_its_pulse_and_the_cameras_lag_is_measured(source):
    reflex = Reflex()
    results = [reflex.frame(k, source=source) for k in range(20)]
    before = [got.stamp_source for got, _ in results[:5]]
    assert before == [source] * 5 and results[0][0].frame.stamp_stddev_s == 0.3
    for got, mid_s in results[5:]:
        assert got.stamp_source == Capture.HARDWARE and not got.remark
        assert got.frame.mid_unix_s == pytest.approx(mid_s, abs=1e-5)
        # the receiver's second, and the unmeasured travel of a curtain
        assert got.frame.clock_stddev_s == 1e-5 and got.frame.stamp_stddev_s == pytest.approx(0.003, abs=1e-5)
    shown = reflex.times.values()
    assert shown["frames with a pulse"] == 15 and shown["measured lag"].startswith(("0.29", "0.30"))


def test_the_travel_of_the_curtain_is_before_the_pulse():
    plain, curtain = Reflex(), Reflex(**{"pulses.curtain": 0.004, "pulses.curtain_stddev": 0.0005})
    for k in range(10):
        (got, _), (earlier, _) = plain.frame(k), curtain.frame(k)
    assert got.frame.mid_unix_s - earlier.frame.mid_unix_s == pytest.approx(0.004, abs=1e-6)
    assert earlier.frame.stamp_stddev_s == pytest.approx(math.hypot(2e-5, 0.0005))


def test_without_a_pulse_a_frame_has_the_lag_of_the_others_and_says_why():
    reflex = Reflex()
    got, _ = reflex.frame(0, pulse=False)
    assert got.stamp_source == Capture.COMMAND and got.frame.stamp_stddev_s == 0.3
    for k in range(1, 1 + ENOUGH_FOR_LAG):
        reflex.frame(k)
    errors = []
    for k in range(20, 60):
        got, mid_s = reflex.frame(k, pulse=False)
        assert got.stamp_source == Capture.COMMAND and "no pulse" in got.remark
        errors.append((got.frame.mid_unix_s - mid_s) / got.frame.stamp_stddev_s)
    assert 0.3 < np.sqrt(np.mean(np.square(errors))) < 1.3


def test_by_the_hosts_clock_alone_that_clocks_error_stays():
    reflex = Reflex()
    for k in range(10):
        got, _ = reflex.frame(k, disciplined=False)
    assert got.stamp_source == Capture.HARDWARE and got.frame.clock_stddev_s == 0


@pytest.mark.parametrize("source", [Capture.HARDWARE, Capture.FILE, Capture.SIMULATED, Capture.UNKNOWN])
def test_a_source_that_tells_its_own_times_keeps_them(source):
    reflex = Reflex()
    results = [reflex.frame(k, source=source)[0] for k in range(10)]
    assert {r.stamp_source for r in results} == {source} and reflex.times.paired == 0


def test_a_pulse_that_is_still_on_the_line_is_waited_for():
    reflex = Reflex(patience_s=WAIT_S)
    for k in range(10):
        reflex.frame(k)
    late = threading.Timer(
        0.02, lambda: (reflex.edge(BEGIN_S + 20.3, False), reflex.edge(BEGIN_S + 20.8, True))
    )
    late.start()
    got, _ = reflex.frame(10, pulse=False)
    late.join()
    assert got.stamp_source == Capture.HARDWARE and got.frame.mid_unix_s == pytest.approx(BEGIN_S + 20.55)

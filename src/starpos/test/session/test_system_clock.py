# SPDX-License-Identifier: Apache-2.0
"""The kernel's word on this machine's clock, and clocks that are set while one watches."""

import math
import platform
import shutil
import subprocess

import pytest

from starpos import system_clock
from starpos.system_clock import StepWatch, SystemClock


def test_the_kernels_word_is_what_the_system_tool_reads():
    state = system_clock.read()
    if state is None:
        pytest.skip("this system does not tell")
    assert state.est_error_s >= 0 and 0 <= state.max_error_s < 100
    if state.synchronised:
        # NTP_PHASE_LIMIT: beyond it the kernel takes the clock for lost.
        assert state.max_error_s <= 16.001
    tool = shutil.which("adjtimex") or shutil.which("ntptime")
    if tool is None:
        return
    command = [tool, "-p"] if tool.endswith("adjtimex") else [tool]
    told = subprocess.run(command, capture_output=True, text=True, check=False).stdout
    words = told.replace(",", " ").replace(":", " ").split()
    key = "maxerror" if "maxerror" in words else "maximum"
    value = float(next(w for w in words[words.index(key) + 1 :] if w.replace(".", "").isdigit()))
    assert state.max_error_s == pytest.approx(value * 1e-6, abs=0.01)


@pytest.mark.skipif(platform.machine() not in ("x86_64", "aarch64"), reason="another layout")
def test_the_kernels_structure_has_its_size():
    # offset of `status` and its size; sizeof(struct timex) of glibc and musl
    assert system_clock.TIMEX.size == 40 + 4
    assert system_clock.TIMEX_BYTES >= 208


def test_what_is_claimed_of_a_clock():
    assert SystemClock(True, 0.03, 0.002).stddev_s == pytest.approx(0.03 / math.sqrt(3))
    # The kernel's own estimate, where that is larger.
    assert SystemClock(True, 0.001, 0.02).stddev_s == 0.02
    # The hour is unknown.
    assert SystemClock(False, 16.0, 16.0).stddev_s > 20000
    assert "not synchronised" in SystemClock(False, 16.0, 16.0).sentence
    assert "0.03 s" in SystemClock(True, 0.03, 0.002).sentence


class Clocks:
    def __init__(self):
        self.utc, self.monotonic = 1.8e9, 100.0

    def go(self, seconds, slew=0.0, step=0.0):
        self.monotonic += seconds
        self.utc += seconds * (1 + slew) + step

    def __call__(self):
        return self.utc, self.monotonic


@pytest.mark.parametrize("step", [2.0, -2.0, 0.2, -3600.0])
def test_a_clock_that_is_set_is_noticed_once_and_by_how_much(step):
    clocks = Clocks()
    watch = StepWatch(clocks)
    clocks.go(1.0)
    assert watch.step_s() == 0
    clocks.go(0.5, step=step)
    assert watch.step_s() == pytest.approx(step, abs=1e-6)
    clocks.go(0.5)
    assert watch.step_s() == 0


def test_a_clock_that_is_slewed_is_not_set():
    clocks = Clocks()
    watch = StepWatch(clocks)
    for slew in (5e-4, -5e-4, 0.083, -0.083):
        clocks.go(60.0, slew=slew)
        assert watch.step_s() == 0

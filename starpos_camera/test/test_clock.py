# SPDX-License-Identifier: Apache-2.0
"""The camera when the system's clock is set while it works."""

import signal
from pathlib import Path

import numpy as np
import pytest
from sensor_msgs.msg import Image

from starpos.frames.frame import Frame
from starpos.messages.stamp import stamp_to_unix
from starpos.system_clock import StepWatch
from starpos_camera.sources.source import CapturedFrame, CaptureError
from starpos_camera.sources.timing import check_one_time
from starpos_interfaces.msg import Capture
from starpos_testing.lacking import lacks

WARN = 1
PLAYED = ("files.loop:=true", "files.restamp:=true", "cadence:=0.1")


@pytest.fixture
def set_clock(tmp_path, monkeypatch):
    """A function of seconds: the clock of processes that start from now on is so much ahead; again while they run."""
    library = next(Path("/usr/lib").glob("**/libfaketimeMT.so.1"), None)
    if library is None:
        lacks("faketime")
    ahead = tmp_path / "ahead"

    def set_clock(seconds: float):
        fresh = ahead.with_suffix(".new")
        fresh.write_text(f"{seconds:+g}\n")
        fresh.rename(ahead)

    set_clock(0)
    monkeypatch.setenv("LD_PRELOAD", str(library))
    monkeypatch.setenv("FAKETIME_TIMESTAMP_FILE", str(ahead))
    monkeypatch.setenv("FAKETIME_CACHE_DURATION", "1")
    monkeypatch.setenv("FAKETIME_DONT_FAKE_MONOTONIC", "1")
    # else a wait of a thread ends at once, again and again
    monkeypatch.setenv("FAKETIME_FORCE_MONOTONIC_FIX", "0")
    return set_clock


def apart_s(captures):
    return np.diff([stamp_to_unix(c.header.stamp) for c in captures])


def test_a_step_is_said_and_the_next_frames_are_in_the_new_time(
    start, listener, folder, set_clock, record_property
):
    listener.hear(Image, "camera/image_raw", 1)
    captures = listener.hear(Capture, "camera/capture")
    node = start("camera", f"files.path:={folder}", *PLAYED)
    listener.wait(lambda: len(captures) >= 3)
    ahead = 0.0
    for step in (10.0, -10.0):
        captures.clear()
        ahead += step
        set_clock(ahead)
        # two frames are further apart than a busy machine makes them, or stand the other way round
        listener.wait(
            lambda step=step: (
                (apart_s(captures) * np.sign(step)).max(initial=0.0) > (9.0 if step > 0 else 1.0)
            )
        )
        state = listener.wait_for_state("camera: Clock", WARN, "clock was set")
        assert float(state["last step (s)"]) == pytest.approx(step, abs=0.05)
        seen = len(captures)
        # The cadence does not hang on this clock.
        listener.wait(lambda seen=seen: len(captures) > seen + 3)
        record_property("fault", f"system clock stepped by {step:+g} s (camera)")
        record_property(
            "result", f"frames go on in the new time; WARN names {state['last step (s)']} s; one log line"
        )
    assert node.end(signal.SIGINT)[1].count("longitudes before and after") == 2


@pytest.mark.parametrize("exposure_s", [0.5, 60.0])
@pytest.mark.parametrize("step", [2.0, -2.0, 0.0])
def test_a_frame_during_which_the_clock_was_set_is_left_out_unless_its_time_is_its_own(step, exposure_s):
    clocks = [1.8e9, 100.0]
    watch = StepWatch(lambda: tuple(clocks))

    def go(seconds, step=0.0):
        clocks[0] += seconds + step
        clocks[1] += seconds

    def take(source):
        before_s = watch.set_s()
        go(0.3, step)
        # The diagnostics ask once a second.
        for _ in range(int(exposure_s)):
            watch.step_s()
            go(1.0)
        frame = CapturedFrame(Frame(np.zeros((4, 4), np.uint8), mid_unix_s=1.8e9), source)
        check_one_time(frame, watch.set_s() - before_s)
        return frame

    assert take(Capture.FILE).frame.width == 4
    if step:
        with pytest.raises(CaptureError, match="the system's clock was set by"):
            take(Capture.COMMAND)
    else:
        assert take(Capture.COMMAND).frame.width == 4

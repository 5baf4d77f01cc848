# SPDX-License-Identifier: Apache-2.0
"""Check of the stamps that the system's clock made: the clock must not be set during an exposure."""

from collections.abc import Callable

from starpos.session.system_clock import StepWatch
from starpos_camera.sources.source import CapturedFrame, CaptureError
from starpos_interfaces.msg import Capture

OF_SYSTEM_CLOCK = (Capture.DRIVER, Capture.COMMAND, Capture.HARDWARE)


def in_one_time(capture: Callable[[], CapturedFrame], watch: StepWatch) -> CapturedFrame:
    """Take a frame with `capture`; CaptureError if the system's clock stamped it and was set meanwhile.

    watch: a StepWatch that another thread asks every second, also during the capture.
    """
    before_s = watch.set_s()
    exposure = capture()
    step_s = watch.set_s() - before_s
    if step_s and exposure.stamp_source in OF_SYSTEM_CLOCK:
        raise CaptureError(
            f"a frame is left out: the system's clock was set by {step_s:+.3g} s while it was taken, so that its time is "
            "ambiguous."
        )
    return exposure

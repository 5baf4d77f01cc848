# SPDX-License-Identifier: Apache-2.0
"""Which stamps the system's clock made, and whether it can be believed."""

from collections.abc import Callable

from starpos_camera.sources.source import CapturedFrame, CaptureError
from starpos_common.system_clock import StepWatch
from starpos_interfaces.msg import Capture

OF_SYSTEM_CLOCK = (Capture.DRIVER, Capture.COMMAND, Capture.HARDWARE)


def in_one_time(capture: Callable[[], CapturedFrame], watch: StepWatch) -> CapturedFrame:
    """What `capture` gives; CaptureError where the system's clock, which stamped it, was set meanwhile.

    watch: one that is asked every second, also while the capture lasts.
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

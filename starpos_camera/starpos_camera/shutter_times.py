# SPDX-License-Identifier: Apache-2.0
"""Times of frames from the pulses of their shutter, which the inclinometer's board has timed."""

import math
import threading
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from starpos.messages.stamp import stamp_to_unix
from starpos.session.shutter_pulses import Edge, Lag, ShutterPulse, ShutterPulses
from starpos_camera.sources.source import CapturedFrame
from starpos_common.parameters import Parameter
from starpos_interfaces.msg import Capture, Pulse

# How long after a frame its pulse may still be on the serial line.
PATIENCE_S = 0.2
# A frame whose own pulse is missing has the lag of the others, if at least this number of frames has shown it.
ENOUGH_FOR_LAG = 10
# A receiver's second is UTC within this.
RECEIVER_STDDEV_S = 1e-5
# The lag that a source's stamps already contain, by where they come from.
LAGS = {Capture.COMMAND: "command_lag", Capture.DRIVER: "driver_lag"}

PARAMETERS = (
    Parameter(
        "pulses",
        False,
        "Take the time of a frame from the shutter's pulse on the topic `pulses` if it belongs to "
        "the frame without doubt. Other frames get the lag that these pulses have shown.",
        read_only=True,
    ),
    Parameter(
        "pulses.curtain",
        0.0,
        "Time from the start of the first row's exposure to the pulse. X sync marks the fully open "
        "shutter, so this is the travel of the curtain, some 0.004 s; it is 0 for a strobe line. 1 "
        "ms is 0.5 m at the equator.",
        unit="s",
        minimum=0.0,
        maximum=1.0,
    ),
    Parameter(
        "pulses.curtain_stddev",
        0.003,
        "Error of pulses.curtain, 1 sigma, the same in all frames.",
        unit="s",
        minimum=0.0,
        maximum=1.0,
    ),
)


class ShutterTimes:
    """Replaces the times of a source's frames by the times of their pulses.

    `hear` is called by the executor's thread, `timed` by the one that captures.
    """

    def __init__(self, values: Mapping[str, Any], patience_s: float = PATIENCE_S) -> None:
        self._values, self._patience_s = values, patience_s
        self._pulses = ShutterPulses()
        self._changed = threading.Condition()
        self._last: Edge | None = None
        self._lag: Lag | None = None
        self.paired = self.heard = 0
        # Why the last frame has no pulse; '' if it has one.
        self.unpaired = "no frame yet"

    def hear(self, message: Pulse) -> None:
        """Take a message of the topic `pulses`."""
        time_s = stamp_to_unix(message.header.stamp)
        if message.input != Pulse.SHUTTER or time_s is None:
            return
        edge = Edge(
            time_s=time_s,
            stddev_s=message.stamp_stddev,
            rising=message.rising,
            sequence=message.sequence,
            disciplined=message.disciplined,
        )
        with self._changed:
            self._pulses.add(edge)
            self._last = edge
            self.heard += 1
            self._changed.notify_all()

    def timed(self, exposure: CapturedFrame, since_s: float, until_s: float) -> CapturedFrame:
        """Date a frame that was captured between two times (Unix s) by its pulse, or by the lag of other frames' ones.

        A frame with neither, or of a source that gives better times itself, is returned unchanged.
        """
        frame, lag = exposure.frame, LAGS.get(exposure.stamp_source)
        if lag is None or not frame.exposure_s or frame.mid_unix_s is None:
            return exposure
        told_s = frame.mid_unix_s - frame.exposure_s / 2 - self._values[lag]
        with self._changed:
            self._changed.wait_for(lambda: self._over_since(since_s), self._patience_s)
            found = self._pulses.pair(told_s, frame.exposure_s, since_s, until_s)
            self._lag = self._pulses.lag
        curtain_s, curtain_stddev_s = self._values["pulses.curtain"], self._values["pulses.curtain_stddev"]
        middle_s = frame.exposure_s / 2 - curtain_s
        if isinstance(found, ShutterPulse):
            self.paired += 1
            self.unpaired = ""
            clock_s = RECEIVER_STDDEV_S if found.disciplined else frame.clock_stddev_s
            known = replace(
                frame,
                mid_unix_s=found.begin_s + middle_s,
                stamp_stddev_s=math.hypot(found.stddev_s, curtain_stddev_s),
                clock_stddev_s=clock_s,
            )
            return replace(exposure, frame=known, stamp_source=Capture.HARDWARE)
        self.unpaired = found.reason
        remark = exposure.remark or f"a frame has no time of its shutter: {found.reason}."
        if self._lag is None or self._lag.frames < ENOUGH_FOR_LAG:
            return replace(exposure, remark=remark)
        known = replace(
            frame,
            mid_unix_s=told_s + self._lag.median_s + middle_s,
            stamp_stddev_s=math.hypot(self._lag.stddev_s, curtain_stddev_s),
        )
        return replace(exposure, frame=known, remark=remark)

    def values(self) -> dict[str, object]:
        """What diagnostics show."""
        lag = self._lag
        told = (
            f"{lag.median_s:.4f} +- {lag.stddev_s:.4f} s, of {lag.frames} frames" if lag else "not known yet"
        )
        return {
            "edges of the shutter": self.heard,
            "frames with a pulse": self.paired,
            "last frame without a pulse": self.unpaired or "no",
            "measured lag": told,
        }

    def _over_since(self, since_s: float) -> bool:
        return self._last is not None and self._last.rising and self._last.time_s >= since_s

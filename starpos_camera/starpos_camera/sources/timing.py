# SPDX-License-Identifier: Apache-2.0
"""Times of frames: what a camera reports, the shutter's pulses, and the check that no clock was set meanwhile."""

import math
import re
import threading
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from starpos.errors import TimeError
from starpos.frames.frame import Frame
from starpos.messages.stamp import stamp_to_unix
from starpos.units import unix_of
from starpos_camera.sources.source import CapturedFrame, CaptureError
from starpos_common.shutter_pulses import Edge, Lag, ShutterPulse, ShutterPulses
from starpos_interfaces.msg import Capture, Pulse

# Hosts whose clock is this machine's.
LOCAL = ("127.0.0.1", "localhost", "::1")
# Tolerance between a driver's times of an exposure and the times of command and arrival.
CLOCK_TOLERANCE_S = 0.05


def clock_stddev_of(source: str, host: str, values: Mapping) -> float:
    """Error of the clock of a server on that host, as `dated_by_driver` takes it."""
    return 0.0 if host in LOCAL else values[f"{source}.clock_stddev"]


def dated(
    frame: Frame, mid_s: float, stddev_s: float, source: int, clock_stddev_s: float = 0.0
) -> CapturedFrame:
    """A frame with the middle of its exposure (Unix time) and its error (s), by one of Capture's sources.

    clock_stddev_s: standard deviation against UTC of another machine's clock; 0: the clock is this machine's.
    """
    stamped = replace(frame, mid_unix_s=mid_s, stamp_stddev_s=stddev_s, clock_stddev_s=clock_stddev_s)
    return CapturedFrame(stamped, source)


def check_exposed(exposure_s: float, wanted_s: float, between_s: tuple[float, float]) -> None:
    """Raise CaptureError unless the exposure that a driver reports fits between command and arrival (Unix s)."""
    commanded_s, ready_s = between_s
    if not 0 < exposure_s <= ready_s - commanded_s + CLOCK_TOLERANCE_S:
        raise CaptureError(
            f"it says that it has exposed for {exposure_s:g} s, when {wanted_s:g} s were asked."
        )


def dated_by_driver(
    frame: Frame,
    told: str,
    clock_stddev_s: float,
    between_s: tuple[float, float],
    values: Mapping,
) -> CapturedFrame:
    """Date a frame, whose exposure is known, by the better time: the driver's start (`told`, ISO 8601), or the command.

    clock_stddev_s: of the driver's clock; 0: it is this machine's clock; NaN: unknown, and the start is not used.
    between_s: Unix times of command and arrival. A start that does not fit between them is not used.
    """
    commanded_s, ready_s = between_s
    commanded = dated_by_command(frame, commanded_s, values)
    start = read_utc(told)
    if start is None or math.isnan(clock_stddev_s):
        return commanded
    start_s, resolution_s = start
    # Some drivers count whole seconds but write .000.
    if start_s % 1 == 0:
        resolution_s = 1.0
    tolerance_s = CLOCK_TOLERANCE_S + resolution_s + 3 * clock_stddev_s
    if max(commanded_s - start_s, start_s + (frame.exposure_s or 0.0) - ready_s) > tolerance_s:
        off = f"its times of exposures are off by more than {tolerance_s:.2g} s and not used"
        return replace(commanded, remark=f"{off}; set its machine's clock, to UTC.")
    started = dated_by_start(frame, start_s, resolution_s, values, clock_stddev_s)
    error_s = math.hypot(started.frame.stamp_stddev_s, clock_stddev_s)
    return commanded if error_s > commanded.frame.stamp_stddev_s else started


def dated_by_command(frame: Frame, commanded_s: float, values: Mapping) -> CapturedFrame:
    """Date a frame, whose exposure is known, by the time of the command alone."""
    middle_s = commanded_s + values["command_lag"] + (frame.exposure_s or 0.0) / 2
    return dated(frame, middle_s, values["command_lag_stddev"], Capture.COMMAND)


def dated_by_start(
    frame: Frame, start_s: float, resolution_s: float, values: Mapping, clock_stddev_s: float = 0.0
) -> CapturedFrame:
    """Date a frame, whose exposure is known, by the start that is reported, rounded or cut at its resolution."""
    stddev_s = math.hypot(values["driver_lag_stddev"], 1.5 * resolution_s / math.sqrt(12))
    middle_s = start_s + values["driver_lag"] + resolution_s / 4 + (frame.exposure_s or 0.0) / 2
    return dated(frame, middle_s, stddev_s, Capture.DRIVER, clock_stddev_s)


def read_utc(text: str) -> tuple[float, float] | None:
    """Read a UTC time in ISO 8601; return Unix time and the resolution of its last digit (s); None if invalid."""
    match = re.fullmatch(
        r"(\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d)(?:\.(\d+))?(?:Z|\+00:00)?", text.strip(), re.ASCII
    )
    if not match:
        return None
    decimals = match[2] or ""
    try:
        whole = unix_of(match[1])
    except TimeError:
        return None
    return whole + float(f"0.{decimals or 0}"), 10.0 ** -len(decimals)


OF_SYSTEM_CLOCK = (Capture.DRIVER, Capture.COMMAND, Capture.HARDWARE)


def check_one_time(exposure: CapturedFrame, step_s: float) -> None:
    """Raise CaptureError if the system's clock stamped a frame and was set by step_s while it was taken."""
    if step_s and exposure.stamp_source in OF_SYSTEM_CLOCK:
        raise CaptureError(
            f"a frame is left out: the system's clock was set by {step_s:+.3g} s while it was taken, so that its time is "
            "ambiguous."
        )


# How long after a frame its pulse may still be on the serial line.
PULSE_PATIENCE_S = 0.2
# A frame whose own pulse is missing has the lag of the others, if at least this number of frames has shown it.
ENOUGH_FOR_LAG = 10
# A receiver's second is UTC within this.
RECEIVER_STDDEV_S = 1e-5
# The lag that a source's stamps already contain, by where they come from.
LAGS = {Capture.COMMAND: "command_lag", Capture.DRIVER: "driver_lag"}


class ShutterTimes:
    """Replaces the times of a source's frames by the times of their pulses.

    `hear` is called by the executor's thread, `date_frame` by the one that captures.
    """

    def __init__(self, values: Mapping[str, Any], patience_s: float = PULSE_PATIENCE_S) -> None:
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
            self._pulses.record(edge)
            self._last = edge
            self.heard += 1
            self._changed.notify_all()

    def date_frame(self, exposure: CapturedFrame, since_s: float, until_s: float) -> CapturedFrame:
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
        source, clock_s, remark = exposure.stamp_source, frame.clock_stddev_s, exposure.remark
        if isinstance(found, ShutterPulse):
            self.paired += 1
            self.unpaired, source = "", Capture.HARDWARE
            begin_s, stddev_s = found.begin_s, found.stddev_s
            clock_s = RECEIVER_STDDEV_S if found.disciplined else clock_s
        else:
            self.unpaired = found
            remark = remark or f"a frame has no time of its shutter: {found}."
            if self._lag is None or self._lag.frames < ENOUGH_FOR_LAG:
                return replace(exposure, remark=remark)
            begin_s, stddev_s = told_s + self._lag.median_s, self._lag.stddev_s
        known = replace(
            frame,
            mid_unix_s=begin_s + frame.exposure_s / 2 - self._values["pulses.curtain"],
            stamp_stddev_s=math.hypot(stddev_s, self._values["pulses.curtain_stddev"]),
            clock_stddev_s=clock_s,
        )
        return replace(exposure, frame=known, stamp_source=source, remark=remark)

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

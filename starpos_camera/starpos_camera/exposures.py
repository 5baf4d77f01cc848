# SPDX-License-Identifier: Apache-2.0
"""What is known of the exposure of a frame: from its Capture message, or from the parameters where none comes."""

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

from std_msgs.msg import Header

from starpos.frames.driver_stamp import DriverStamp
from starpos.frames.frame import Frame
from starpos.messages.stars import message_to_shutter
from starpos_interfaces.msg import Capture

CAPTURES_KEPT = 16


class ExposureFacts:
    """Keeps Captures by their stamps, and adds what they tell to their frames.

    values: the parameters of the detector.
    """

    def __init__(self, values: Mapping[str, Any]) -> None:
        self._values = values
        # the oldest first
        self._captures: dict[tuple[int, int], Capture] = {}
        # what holds for a frame whose Capture is lost; None: no Capture has ever come
        self._usual: Capture | None = None

    def take(self, message: Capture) -> None:
        """Take a Capture."""
        if len(self._captures) >= CAPTURES_KEPT:
            del self._captures[next(iter(self._captures))]
        self._captures[key_of(message.header)] = message

    def has(self, header: Header) -> bool:
        """Whether the Capture of a frame is here."""
        return key_of(header) in self._captures

    @property
    def unsaid(self) -> str:
        """Sentence on what the user has to state of the camera; '' where Captures come, or all is stated."""
        return "" if self._usual else self._driver_stamp.unsaid

    def of(self, header: Header) -> tuple[Header, Callable[[Frame], Frame]]:
        """The header of the middle of a frame's exposure, and what adds the exposure to the frame.

        From its Capture; where that is lost, with the errors and the shutter of the last one; where none has ever come,
        from the parameters. The frame has the stamp of its message. Raises StarposError for what no exposure can have.
        """
        capture = self._captures.pop(key_of(header), None) or self._usual
        if capture is None:
            driver = self._driver_stamp
            return _later(header, driver.to_middle_s), driver.dated
        told = (capture.exposure, capture.stamp_stddev, capture.clock_stddev)
        exposure, stamp, clock = (v if math.isfinite(v) and v > 0 else 0.0 for v in told)
        facts: dict[str, Any] = {
            "exposure_s": exposure or self._values["exposure"] or None,
            "stamp_stddev_s": stamp,
            "clock_stddev_s": clock,
            "shutter": message_to_shutter(capture),
        }
        # the errors of a camera's times and its shutter are those of its other frames; its exposure may not be
        self._usual = Capture(
            stamp_stddev=capture.stamp_stddev,
            clock_stddev=capture.clock_stddev,
            shutter_known=capture.shutter_known,
            readout=capture.readout,
            readout_stddev=capture.readout_stddev,
        )
        return header, lambda frame: replace(frame, **facts)

    @property
    def _driver_stamp(self) -> DriverStamp:
        v = self._values
        return DriverStamp(v["stamp"], v["stamp_stddev"], v["exposure"] or None, v["readout"])


def key_of(header: Header) -> tuple[int, int]:
    """The stamp of a message, s and ns: by it messages of one frame find each other."""
    return header.stamp.sec, header.stamp.nanosec


def _later(header: Header, by_s: float) -> Header:
    """A header whose stamp is later by a time, to the nanosecond."""
    later = Header(frame_id=header.frame_id)
    total_ns = header.stamp.sec * 10**9 + header.stamp.nanosec + round(by_s * 1e9)
    later.stamp.sec, later.stamp.nanosec = divmod(total_ns, 10**9)
    return later

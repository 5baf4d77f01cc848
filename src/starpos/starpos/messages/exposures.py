# SPDX-License-Identifier: Apache-2.0
"""The exposure of a frame as far as known: from its Capture message, or from the parameters without one."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

from starpos.errors import TimeError
from starpos.frames.driver_stamp import UNKNOWN, DriverStamp
from starpos.frames.frame import Frame
from starpos.frames.shutter import Shutter
from starpos.messages.stars import message_to_shutter

CAPTURES_KEPT = 16
# Capture.stamp_source of one that does not know
UNKNOWN_SOURCE = 0
NANO = 10**9


@dataclass(frozen=True)
class _Facts:
    """The exposure by a Capture; exposure_s: 0 if unknown."""

    exposure_s: float
    stamp_stddev_s: float
    clock_stddev_s: float
    shutter: Shutter | None


class ExposureFacts:
    """Keeps Captures by their stamps, and adds their contents to their frames.

    values: the parameters of the detector.
    """

    def __init__(self, values: Mapping[str, Any]) -> None:
        self._values = values
        # whether Captures have come that state only exposures
        self._exposures_come = False
        # the oldest first
        self._captures: dict[tuple[int, int], Any] = {}
        # facts for a frame whose Capture is lost; None: no Capture has ever come
        self._usual: _Facts | None = None

    def take(self, message: Any) -> None:
        """Take a Capture."""
        if len(self._captures) >= CAPTURES_KEPT:
            del self._captures[next(iter(self._captures))]
        self._captures[key_of(message.header)] = message

    def has(self, header: Any) -> bool:
        """Whether the Capture of a frame is here."""
        return key_of(header) in self._captures

    @property
    def unsaid(self) -> str:
        """Sentence on the parameters to state of the camera; '' if Captures come, or all are stated."""
        return "" if self._usual else self._driver_stamp(1.0 if self._exposures_come else 0.0).unsaid

    def of(self, header: Any) -> tuple[int, Callable[[Frame], Frame]]:
        """The middle of a frame's exposure, ns since 1970, and what adds the exposure to the frame.

        From its Capture; where that is lost, with the errors and the shutter of the last one; where none has ever come,
        from the parameters. If `stamp` is set, a Capture without a stamp source gives only the exposure, which varies
        under automatic exposure, and the parameters give the rest. The frame has the stamp of its message.
        Raises StarposError for impossible values.
        """
        stamp_ns = header.stamp.sec * NANO + header.stamp.nanosec
        capture = self._captures.pop(key_of(header), None)
        told = None if capture is None else _facts_of(capture)
        of_driver = capture is not None and self._is_of_driver(capture)
        self._exposures_come |= of_driver
        facts = None if of_driver else told or self._usual
        if facts is None:
            driver = self._driver_stamp(told.exposure_s if told else 0.0)
            mid_ns = stamp_ns + round(driver.to_middle_s * 1e9)
            if mid_ns <= 0:
                raise TimeError(
                    "image_raw: the middle of the exposure is before 1970; check the camera's clock."
                )
            return mid_ns, driver.dated
        known: dict[str, Any] = {
            "exposure_s": facts.exposure_s or self._values["exposure"] or None,
            "stamp_stddev_s": facts.stamp_stddev_s,
            "clock_stddev_s": facts.clock_stddev_s,
            "shutter": facts.shutter,
        }
        # the errors of a camera's times and its shutter are the same in all its frames; its exposure may differ
        self._usual = replace(facts, exposure_s=0.0)
        return stamp_ns, lambda frame: replace(frame, **known)

    def _is_of_driver(self, capture: Any) -> bool:
        """Whether a Capture leaves the meaning of the stamp to the parameters."""
        return capture.stamp_source == UNKNOWN_SOURCE and self._values["stamp"] != UNKNOWN

    def _driver_stamp(self, exposure_s: float) -> DriverStamp:
        """The meaning of a driver's stamp by the parameters; exposure_s: from a Capture, 0 without one."""
        v = self._values
        exposure_s = exposure_s or v["exposure"]
        return DriverStamp(v["stamp"], v["stamp_stddev"], exposure_s or None, v["readout"])


def _facts_of(capture: Any) -> _Facts:
    told = (capture.exposure, capture.stamp_stddev, capture.clock_stddev)
    exposure, stamp, clock = (float(v) if math.isfinite(v) and v > 0 else 0.0 for v in told)
    return _Facts(exposure, stamp, clock, message_to_shutter(capture))


def key_of(header: Any) -> tuple[int, int]:
    """The stamp of a message, s and ns, which identifies the messages of one frame."""
    return header.stamp.sec, header.stamp.nanosec


def check_stamp(header: Any) -> None:
    """Raise TimeError if the stamp of an image is not set, or is not a time."""
    sec, nanosec = key_of(header)
    if not sec and not nanosec:
        raise TimeError(
            "image_raw: the frame has no time stamp; set header.stamp to the middle of the exposure."
        )
    if sec < 0 or nanosec >= NANO:
        raise TimeError(
            f"image_raw: the stamp {sec} s {nanosec} ns is no time after 1970; check the camera's clock."
        )

# SPDX-License-Identifier: Apache-2.0
"""What is known of the exposure of a frame: from its Capture message, or from the parameters where none comes."""

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
    """What a Capture tells of an exposure; exposure_s: 0 where it is not known."""

    exposure_s: float
    stamp_stddev_s: float
    clock_stddev_s: float
    shutter: Shutter | None


class ExposureFacts:
    """Keeps Captures by their stamps, and adds what they tell to their frames.

    values: the parameters of the detector.
    """

    def __init__(self, values: Mapping[str, Any]) -> None:
        self._values = values
        # whether Captures have come that tell nothing but exposures
        self._exposures_come = False
        # the oldest first
        self._captures: dict[tuple[int, int], Any] = {}
        # what holds for a frame whose Capture is lost; None: no Capture has ever come
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
        """Sentence on what the user has to state of the camera; '' where Captures come, or all is stated."""
        return "" if self._usual else self._driver_stamp(1.0 if self._exposures_come else 0.0).unsaid

    def of(self, header: Any) -> tuple[int, Callable[[Frame], Frame]]:
        """The middle of a frame's exposure, ns since 1970, and what adds the exposure to the frame.

        From its Capture; where that is lost, with the errors and the shutter of the last one; where none has ever come,
        from the parameters. Where `stamp` is set, a Capture without a stamp source tells the exposure alone, which
        changes with automatic ones, and the parameters tell the rest. The frame has the stamp of its message.
        Raises StarposError for what no exposure can have.
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
        # the errors of a camera's times and its shutter are those of its other frames; its exposure may not be
        self._usual = replace(facts, exposure_s=0.0)
        return stamp_ns, lambda frame: replace(frame, **known)

    def _is_of_driver(self, capture: Any) -> bool:
        """Whether a Capture leaves it to the parameters what the stamp is."""
        return capture.stamp_source == UNKNOWN_SOURCE and self._values["stamp"] != UNKNOWN

    def _driver_stamp(self, exposure_s: float) -> DriverStamp:
        """The meaning of a driver's stamp by the parameters; exposure_s: that a Capture tells, 0 where none does."""
        v = self._values
        exposure_s = exposure_s or v["exposure"]
        return DriverStamp(v["stamp"], v["stamp_stddev"], exposure_s or None, v["readout"])


def _facts_of(capture: Any) -> _Facts:
    told = (capture.exposure, capture.stamp_stddev, capture.clock_stddev)
    exposure, stamp, clock = (float(v) if math.isfinite(v) and v > 0 else 0.0 for v in told)
    return _Facts(exposure, stamp, clock, message_to_shutter(capture))


def key_of(header: Any) -> tuple[int, int]:
    """The stamp of a message, s and ns: by it messages of one frame find each other."""
    return header.stamp.sec, header.stamp.nanosec


def check_stamp(header: Any) -> None:
    """Raise TimeError if the stamp of an image is not set, or is no time."""
    sec, nanosec = key_of(header)
    if not sec and not nanosec:
        raise TimeError(
            "image_raw: the frame has no time stamp; set header.stamp to the middle of the exposure."
        )
    if sec < 0 or nanosec >= NANO:
        raise TimeError(
            f"image_raw: the stamp {sec} s {nanosec} ns is no time after 1970; check the camera's clock."
        )

# SPDX-License-Identifier: Apache-2.0
"""What a camera's driver sends: the camera from a CameraInfo, frames from images, their exposures from Captures."""

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from starpos.errors import InstrumentError, TimeError
from starpos.frames.encodings import pixels_of
from starpos.frames.exposure import UNKNOWN_STAMP, DriverStamp
from starpos.frames.frame import Frame
from starpos.frames.pictures import picture_pixels
from starpos.instrument.camera import Camera, check_axis, stated_lens
from starpos.messages.stamp import stamp_to_ns, stamp_to_unix
from starpos.messages.stars import message_to_shutter


def message_to_camera(
    message: Any, source: str = "camera_info", size: tuple[int, int] | None = None
) -> Camera:
    """Camera of the images that a CameraInfo goes with; raises InstrumentError unless it is calibrated.

    Its model is plumb_bob, also where none is named, rational_polynomial or equidistant. K is for the whole sensor; the
    camera's is for the message's region and binning.
    size: width and height of the images, px, for a message that leaves its own at 0.
    """
    k = np.array(message.k, float)
    d = np.array(message.d, float)
    if not np.isfinite(k).all() or not np.isfinite(d).all():
        raise InstrumentError(f"{source}: K or D holds NaN or infinity; calibrate the camera.")
    if not k[0] or not k[4]:
        raise InstrumentError(
            f"{source}: the camera is not calibrated (its focal length is 0); give it a calibration file."
        )
    model, distortion = stated_lens(message.distortion_model, d.tolist(), source)
    if np.any(k[[1, 3, 6, 7]]) or k[8] != 1:
        raise InstrumentError(
            f"{source}: K is not [fx 0 cx, 0 fy cy, 0 0 1]; calibrate the camera without skew."
        )
    check_axis(message.width, message.height, k[2], k[5], source)
    region, by_x, by_y = message.roi, max(1, message.binning_x), max(1, message.binning_y)
    width = _image_side(message.width, region.x_offset, region.width, by_x, source)
    height = _image_side(message.height, region.y_offset, region.height, by_y, source)
    if size is not None and leaves_size_open(message):
        width, height = size
    fx, fy, cx, cy = k[[0, 4, 2, 5]].tolist()
    return Camera(
        width=width,
        height=height,
        fx=fx / by_x,
        fy=fy / by_y,
        # the corner of the first pixel, half a pixel from its centre, is the same before and after binning
        cx=(cx - region.x_offset + 0.5) / by_x - 0.5,
        cy=(cy - region.y_offset + 0.5) / by_y - 0.5,
        distortion=distortion,
        model=model,
    )


def leaves_size_open(message: Any) -> bool:
    """Whether a CameraInfo states no size; then the images' size holds."""
    region = message.roi
    return not (message.width or region.width) or not (message.height or region.height)


def _image_side(whole: int, offset: int, cut: int, binned_by: int, source: str) -> int:
    """Pixels along a side of the images: the binned ones of the sensor, or of a part `cut` of it; 0 if not stated."""
    if whole and offset + cut > whole:
        raise InstrumentError(
            f"{source}: the region of interest ends at pixel {offset + cut} of {whole}; width and height "
            f"must be the whole sensor's: correct the camera's driver or its calibration file."
        )
    return (cut or max(0, whole - offset)) // binned_by


def message_to_frame(message: Any, source: str = "image_raw") -> Frame:
    """Frame from an Image, on the message's own memory where that holds pixels as a Frame does, else on a copy.

    Raises FrameError if encoding, size, step and data do not fit together.
    """
    pixels, pattern = pixels_of(
        message.encoding,
        message.data,
        message.width,
        message.height,
        message.step,
        bool(message.is_bigendian),
        source,
    )
    return Frame(pixels, pattern=pattern, mid_unix_s=stamp_to_unix(message.header.stamp), source=source)


def message_to_picture(message: Any, source: str = "image_raw/compressed") -> Frame:
    """Frame from a CompressedImage: JPEG, PNG or TIFF; raises FrameError if it is not a whole picture."""
    pixels = picture_pixels(bytes(message.data), source)
    return Frame(pixels, mid_unix_s=stamp_to_unix(message.header.stamp), source=source)


CAPTURES_KEPT = 16
# Capture.stamp_source of one that does not know
UNKNOWN_SOURCE = 0


class ExposureFacts:
    """Keeps Captures by their stamps, and adds their contents to their frames.

    values: the parameters of the detector.
    """

    def __init__(self, values: Mapping[str, Any]) -> None:
        self._values = values
        # whether Captures have come that state only exposures
        self._exposures_come = False
        # the oldest first
        self._captures: dict[int, Any] = {}
        # facts for a frame whose Capture is lost; None: no Capture has ever come
        self._usual: dict[str, Any] | None = None

    def keep_capture(self, message: Any) -> None:
        """Keep a Capture for its frame."""
        if len(self._captures) >= CAPTURES_KEPT:
            del self._captures[next(iter(self._captures))]
        self._captures[stamp_to_ns(message.header.stamp)] = message

    def has(self, header: Any) -> bool:
        """Whether the Capture of a frame is here."""
        return stamp_to_ns(header.stamp) in self._captures

    @property
    def missing_statement(self) -> str:
        """Sentence on the parameters to state of the camera; '' if Captures come, or all are stated."""
        return (
            "" if self._usual else self._driver_stamp(1.0 if self._exposures_come else 0.0).missing_statement
        )

    def of(self, header: Any) -> tuple[int, Callable[[Frame], Frame]]:
        """The middle of a frame's exposure, ns since 1970, and what adds the exposure to the frame.

        From its Capture; where that is lost, with the errors and the shutter of the last one; where none has ever come,
        from the parameters. If `stamp` is set, a Capture without a stamp source gives only the exposure, which varies
        under automatic exposure, and the parameters give the rest. The frame has the stamp of its message.
        Raises StarposError for impossible values.
        """
        stamp_ns = stamp_to_ns(header.stamp)
        capture = self._captures.pop(stamp_ns, None)
        told = None if capture is None else _facts_of(capture)
        # whether it leaves the meaning of the stamp to the parameters
        unsaid = capture is not None and capture.stamp_source == UNKNOWN_SOURCE
        of_driver = unsaid and self._values["stamp"] != UNKNOWN_STAMP
        self._exposures_come |= of_driver
        facts = None if of_driver else told or self._usual
        if facts is None:
            driver = self._driver_stamp(told["exposure_s"] if told else 0.0)
            mid_ns = stamp_ns + round(driver.to_middle_s * 1e9)
            if mid_ns <= 0:
                raise TimeError(
                    "image_raw: the middle of the exposure is before 1970; check the camera's clock."
                )
            return mid_ns, driver.apply
        known = facts | {"exposure_s": facts["exposure_s"] or self._values["exposure"] or None}
        # the errors of a camera's times and its shutter are the same in all its frames; its exposure may differ
        self._usual = facts | {"exposure_s": 0.0}
        return stamp_ns, lambda frame: replace(frame, **known)

    def _driver_stamp(self, exposure_s: float) -> DriverStamp:
        """The meaning of a driver's stamp by the parameters; exposure_s: from a Capture, 0 without one."""
        v = self._values
        exposure_s = exposure_s or v["exposure"]
        return DriverStamp(v["stamp"], v["stamp_stddev"], exposure_s or None, v["readout"])


def _facts_of(capture: Any) -> dict[str, Any]:
    """The fields of a Frame that a Capture gives; exposure_s: 0 if unknown."""
    told = (capture.exposure, capture.stamp_stddev, capture.clock_stddev)
    exposure, stamp, clock = (float(v) if math.isfinite(v) and v > 0 else 0.0 for v in told)
    errors = {"stamp_stddev_s": stamp, "clock_stddev_s": clock}
    return {"exposure_s": exposure, **errors, "shutter": message_to_shutter(capture)}


def check_stamp(header: Any) -> None:
    """Raise TimeError if the stamp of an image is not set, or is not a time."""
    sec, nanosec = header.stamp.sec, header.stamp.nanosec
    if not sec and not nanosec:
        raise TimeError(
            "image_raw: the frame has no time stamp; set header.stamp to the middle of the exposure."
        )
    if sec < 0 or nanosec >= 10**9:
        raise TimeError(
            f"image_raw: the stamp {sec} s {nanosec} ns is no time after 1970; check the camera's clock."
        )

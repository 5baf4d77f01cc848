# SPDX-License-Identifier: Apache-2.0
"""A camera from a CameraInfo, and its frames from an Image."""

from typing import Any

import numpy as np

from starpos.errors import FrameError, InstrumentError
from starpos.frames.frame import Frame
from starpos.instrument.camera import Camera
from starpos.instrument.lens import COEFFICIENTS, PLUMB_BOB
from starpos.messages.stamp import stamp_to_unix

# encoding -> (dtype, channels, pattern); the names of sensor_msgs/image_encodings.hpp
ENCODINGS = {
    "mono8": (np.uint8, 1, ""),
    "mono16": (np.uint16, 1, ""),
    "bgr8": (np.uint8, 3, ""),
    **{f"bayer_{p}8": (np.uint8, 1, p) for p in ("rggb", "bggr", "grbg", "gbrg")},
    **{f"bayer_{p}16": (np.uint16, 1, p) for p in ("rggb", "bggr", "grbg", "gbrg")},
}


def message_to_camera(message: Any, source: str = "camera_info") -> Camera:
    """Camera from a CameraInfo; raises InstrumentError unless it is a calibrated camera of the whole frame.

    Its model is plumb_bob, also where none is named, or equidistant.
    """
    k = np.array(message.k, float)
    d = np.array(message.d, float)
    if not np.isfinite(k).all() or not np.isfinite(d).all():
        raise InstrumentError(f"{source}: K or D holds NaN or infinity; calibrate the camera.")
    if not k[0] or not k[4]:
        raise InstrumentError(
            f"{source}: the camera is not calibrated (its focal length is 0); give it a calibration file."
        )
    model = message.distortion_model or PLUMB_BOB
    if model not in COEFFICIENTS or len(d) not in (0, len(COEFFICIENTS[model])):
        known = " and ".join(f"{name!r} with {len(terms)}" for name, terms in COEFFICIENTS.items())
        raise InstrumentError(
            f"{source}: the distortion model is {message.distortion_model!r} with {len(d)} terms; {known} are "
            "understood: calibrate with one of them."
        )
    if np.any(k[[1, 3, 6, 7]]) or k[8] != 1:
        raise InstrumentError(
            f"{source}: K is not [fx 0 cx, 0 fy cy, 0 0 1]; calibrate the camera without skew."
        )
    region = message.roi
    cropped = (region.x_offset, region.y_offset) != (0, 0) or (
        (region.width, region.height) not in ((0, 0), (message.width, message.height))
    )
    if cropped or message.binning_x > 1 or message.binning_y > 1:
        raise InstrumentError(
            f"{source}: the frame is binned or cropped; send whole frames, or calibrate it as it is sent."
        )
    fx, fy, cx, cy = k[[0, 4, 2, 5]].tolist()
    return Camera(
        width=message.width,
        height=message.height,
        fx=fx,
        fy=fy,
        cx=cx,
        cy=cy,
        distortion=tuple(d.tolist()),
        model=model,
    )


def message_to_frame(message: Any, source: str = "image_raw") -> Frame:
    """Frame from an Image, on the message's own memory if byte order and alignment allow it, else on a copy.

    Raises FrameError if encoding, size, step and data do not fit together.
    """
    if message.encoding not in ENCODINGS:
        raise FrameError(
            f"{source}: the encoding {message.encoding!r} is unknown; send one of {', '.join(ENCODINGS)}."
        )
    kind, channels, pattern = ENCODINGS[message.encoding]
    width, height, step = message.width, message.height, message.step
    row = width * channels * np.dtype(kind).itemsize
    if not width or not height:
        raise FrameError(f"{source}: the frame is {width} x {height} px; it is empty, check the camera.")
    if step < row:
        raise FrameError(
            f"{source}: step is {step} bytes but a row of {width} px needs {row}; check the camera driver."
        )
    if len(message.data) != step * height:
        raise FrameError(
            f"{source}: {len(message.data)} bytes of pixels for {height} rows of {step} bytes; "
            "the frame is truncated or its sizes are wrong."
        )
    dtype = np.dtype(kind).newbyteorder(">" if message.is_bigendian else "<")
    shape = (height, width) if channels == 1 else (height, width, channels)
    strides = (step, dtype.itemsize) if channels == 1 else (step, channels, 1)
    pixels: np.ndarray = np.ndarray(shape, dtype, message.data, strides=strides)
    if not pixels.dtype.isnative or not pixels.flags.aligned:
        pixels = pixels.astype(kind)
    return Frame(pixels, pattern=pattern, mid_unix_s=stamp_to_unix(message.header.stamp), source=source)

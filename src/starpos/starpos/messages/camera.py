# SPDX-License-Identifier: Apache-2.0
"""A camera from a CameraInfo, and its frames from an Image or a CompressedImage."""

from typing import Any

import numpy as np

from starpos.errors import InstrumentError
from starpos.frames.encodings import pixels_of
from starpos.frames.frame import Frame
from starpos.frames.pictures import picture_pixels
from starpos.instrument.camera import Camera
from starpos.instrument.lens import stated_lens
from starpos.messages.stamp import stamp_to_unix


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

# SPDX-License-Identifier: Apache-2.0
"""The pixels in an image message, by the name of their encoding.

The names are from sensor_msgs/image_encodings.hpp, with cv_bridge's numbers of a type (`16UC1`), in upper or lower case.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from starpos.errors import FrameError
from starpos.frames.frame import PATTERNS
from starpos.frames.pictures import frame_pixels
from starpos.frozen import at_once

MOSAICS = tuple(filter(None, PATTERNS))


@at_once
@dataclass(frozen=True)
class Encoding:
    """How pixels lie in a row.

    dtype     of a number of the row
    numbers   of a pixel in the row
    convert   takes the rows (h, w, numbers), or (h, w) of one number; returns the pixels of a Frame
    pattern   of a colour mosaic, as a Frame's
    """

    dtype: type[np.generic] = np.uint8
    numbers: int = 1
    convert: Callable[[np.ndarray], np.ndarray] | None = None
    pattern: str = ""

    def row_bytes(self, width: int) -> int:
        """Bytes of a row of `width` pixels, without padding."""
        return width * self.numbers * np.dtype(self.dtype).itemsize


def pixels_of(
    encoding: str, data: bytes, width: int, height: int, step: int, big_endian: bool, place: str
) -> tuple[np.ndarray, str]:
    """The pixels and the mosaic's pattern of a Frame, on the memory of `data` where it already is what a Frame holds.

    step: bytes from a row to the next.  Bytes after the last row are left out: they pad a driver's buffer, or are
    colours that follow the brightness.
    FrameError if encoding, sizes and data do not fit together.
    """
    layout = ENCODINGS.get(encoding) or ENCODINGS.get(encoding.lower())
    if layout is None:
        raise FrameError(
            f"{place}: the encoding {encoding[:40]!r} is unknown; set the camera's driver to one of "
            f"{', '.join(ENCODINGS)}."
        )
    if not width or not height:
        raise FrameError(f"{place}: the frame is {width} x {height} px; it is empty, check the camera.")
    row = layout.row_bytes(width)
    if step < row:
        raise FrameError(
            f"{place}: step is {step} bytes but a row of {width} px needs {row}; check the camera driver."
        )
    if len(data) < step * height:
        raise FrameError(
            f"{place}: {len(data)} bytes of pixels for {height} rows of {step} bytes; "
            "the frame is truncated or its sizes are wrong."
        )
    rows = _rows(layout, data, (width, height, step), big_endian)
    return (layout.convert(rows) if layout.convert else rows), layout.pattern


def _rows(layout: Encoding, data: bytes, sizes: tuple[int, int, int], big_endian: bool) -> np.ndarray:
    """The numbers in the rows: (h, w, numbers), or (h, w) of one number."""
    (width, height, step), numbers = sizes, layout.numbers
    dtype = np.dtype(layout.dtype).newbyteorder(">" if big_endian else "<")
    shape = (height, width) if numbers == 1 else (height, width, numbers)
    strides = (step, dtype.itemsize) if numbers == 1 else (step, numbers * dtype.itemsize, dtype.itemsize)
    rows: np.ndarray = np.ndarray(shape, dtype, data, strides=strides)
    return rows if rows.dtype.isnative and rows.flags.aligned else rows.astype(layout.dtype)


def _signed(rows: np.ndarray) -> np.ndarray:
    """Numbers with a sign, moved by half of their range: the least is 0."""
    unsigned = np.dtype(f"u{rows.itemsize}")
    half = unsigned.type(1 << 8 * rows.itemsize - 1)
    return np.ascontiguousarray(rows).view(unsigned) ^ half


def _colours(to_bgr: str) -> Callable[[np.ndarray], np.ndarray]:
    """Colours of 8 bits as BGR, by the name of OpenCV's conversion; of 16 bits their mean, as of deep pictures."""

    def convert(rows: np.ndarray) -> np.ndarray:
        import cv2

        if rows.dtype == np.uint16:
            return frame_pixels(rows, "")
        return cv2.cvtColor(rows, getattr(cv2, to_bgr))

    return convert


def _signed_colours(rows: np.ndarray) -> np.ndarray:
    return frame_pixels(_signed(rows), "")


def _brightness(place: int) -> Callable[[np.ndarray], np.ndarray]:
    """Take the brightness from pairs of bytes, a brightness and a colour each."""

    def convert(rows: np.ndarray) -> np.ndarray:
        return np.ascontiguousarray(rows[:, :, place])

    return convert


def _of_type(
    name: str, dtype: type[np.generic], one: Callable | None, three: Callable | None
) -> dict[str, Encoding]:
    """Numbers without a meaning, of one channel or three (taken as BGR), by cv_bridge's names."""
    return {
        name: Encoding(dtype, 1, one),
        f"{name}C1": Encoding(dtype, 1, one),
        f"{name}C3": Encoding(dtype, 3, three),
    }


# By name; the first of each meaning is what `starpos` sends itself.
ENCODINGS: dict[str, Encoding] = {
    "mono8": Encoding(),
    "mono16": Encoding(np.uint16),
    "bgr8": Encoding(np.uint8, 3),
    **{f"bayer_{p}8": Encoding(pattern=p) for p in MOSAICS},
    **{f"bayer_{p}16": Encoding(np.uint16, pattern=p) for p in MOSAICS},
    **{
        f"{order}{bits}": Encoding(dtype, len(order), _colours(f"COLOR_{order.upper()}2BGR"))
        for order in ("rgb", "rgba", "bgra")
        for bits, dtype in ((8, np.uint8), (16, np.uint16))
    },
    "bgr16": Encoding(np.uint16, 3, _colours("")),
    **_of_type("8U", np.uint8, None, None),
    **_of_type("8S", np.int8, _signed, _signed_colours),
    **_of_type("16U", np.uint16, None, _colours("")),
    **_of_type("16S", np.int16, _signed, _signed_colours),
    "uyvy": Encoding(np.uint8, 2, _brightness(1)),
    "yuv422": Encoding(np.uint8, 2, _brightness(1)),
    "yuyv": Encoding(np.uint8, 2, _brightness(0)),
    "yuv422_yuy2": Encoding(np.uint8, 2, _brightness(0)),
    # the plane of brightness comes first
    "nv12": Encoding(),
    "nv21": Encoding(),
    "nv24": Encoding(),
    "mono10": Encoding(np.uint16),
    "mono12": Encoding(np.uint16),
}

# SPDX-License-Identifier: Apache-2.0
"""The pixels in an image message, by the name of their encoding.

The names are from sensor_msgs/image_encodings.hpp, with cv_bridge's numbers of a type (`16UC1`), and GenICam's of
packed pixels (Pixel Format Naming Convention: `Mono12p`; GigE Vision: `Mono12Packed`), in upper or lower case.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from starpos.errors import FrameError
from starpos.frames.frame import PATTERNS
from starpos.frames.pictures import frame_pixels
from starpos.frozen import at_once

MOSAICS = tuple(filter(None, PATTERNS))
COLOURS = ("rgb", "rgba", "bgra")


@at_once
@dataclass(frozen=True)
class Encoding:
    """How pixels lie in a row.

    dtype     of a number of the row
    numbers   of a pixel in the row; a fraction where pixels are packed into bytes
    convert   takes the rows (h, w, numbers), or (h, w) of one number, or (h, bytes) of packed pixels; returns the pixels
              of a Frame, with the padding of packed rows
    pattern   of a colour mosaic, as a Frame's
    """

    dtype: type[np.generic] = np.uint8
    numbers: float = 1
    convert: Callable[[np.ndarray], np.ndarray] | None = None
    pattern: str = ""

    def row_bytes(self, width: int) -> int:
        """Bytes of a row of `width` pixels, without padding."""
        return -int(-width * self.numbers * np.dtype(self.dtype).itemsize // 1)


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
    dtype, numbers = np.dtype(layout.dtype).newbyteorder(">" if big_endian else "<"), int(layout.numbers)
    shape, strides = (height, width, numbers), (step, numbers * dtype.itemsize, dtype.itemsize)
    if numbers != layout.numbers:
        # packed into bytes
        shape, strides = (height, row, 1), (step, 1, 1)
    rows: np.ndarray = np.ndarray(shape, dtype, data, strides=strides)
    if shape[2] == 1:
        rows = rows[:, :, 0]
    if not (rows.dtype.isnative and rows.flags.aligned):
        rows = rows.astype(layout.dtype)
    return (layout.convert(rows)[:, :width] if layout.convert else rows), layout.pattern


def _signed(rows: np.ndarray) -> np.ndarray:
    """Numbers with a sign, moved by half of their range: the least is 0."""
    unsigned = np.dtype(f"u{rows.itemsize}")
    half = unsigned.type(1 << 8 * rows.itemsize - 1)
    return np.ascontiguousarray(rows).view(unsigned) ^ half


# the mean of deep colours, as of deep pictures
_mean = partial(frame_pixels, place="")


def _signed_colours(rows: np.ndarray) -> np.ndarray:
    return _mean(_signed(rows))


def _to_bgr(conversion: str, rows: np.ndarray) -> np.ndarray:
    """Colours of 8 bits as BGR, by the name of OpenCV's conversion."""
    import cv2

    return cv2.cvtColor(rows, getattr(cv2, conversion))


def _brightness(place: int, rows: np.ndarray) -> np.ndarray:
    """The brightness in pairs of bytes, a brightness and a colour each."""
    return np.ascontiguousarray(rows[:, :, place])


def _in_groups(rows: np.ndarray, size: int) -> np.ndarray:
    """Bytes (h, groups, size) of rows (h, bytes), the last group filled up with zeros."""
    height, length = rows.shape
    whole = np.zeros((height, -(-length // size) * size), np.uint16)
    whole[:, :length] = rows
    return whole.reshape(height, -1, size)


def _bit_stream(bits: int, rows: np.ndarray) -> np.ndarray:
    """Pixels of 10 or 12 bits one after another, the low bits first (`Mono10p`, `Mono12p`)."""
    # the fewest bytes that hold whole pixels
    size, count = (5, 4) if bits == 10 else (3, 2)
    groups = _in_groups(rows, size)
    out = np.empty((*groups.shape[:2], count), np.uint16)
    for k in range(count):
        byte, shift = divmod(bits * k, 8)
        both = groups[:, :, byte] >> shift | groups[:, :, byte + 1] << 8 - shift
        out[:, :, k] = both & (1 << bits) - 1
    return out.reshape(len(rows), -1)


def _gige_vision(bits: int, rows: np.ndarray) -> np.ndarray:
    """Two pixels in three bytes: high bits, low bits of both, high bits (`Mono10Packed`, `Mono12Packed`)."""
    low, groups = bits - 8, _in_groups(rows, 3)
    out = np.empty((*groups.shape[:2], 2), np.uint16)
    out[:, :, 0] = groups[:, :, 0] << low | groups[:, :, 1] & (1 << low) - 1
    out[:, :, 1] = groups[:, :, 2] << low | groups[:, :, 1] >> 4 & (1 << low) - 1
    return out.reshape(len(rows), -1)


def _of_type(
    name: str, dtype: type[np.generic], one: Callable | None, three: Callable | None
) -> dict[str, Encoding]:
    """Numbers without a meaning, of one channel or three (taken as BGR), by cv_bridge's names."""
    return {
        name: Encoding(dtype, 1, one),
        f"{name}C1": Encoding(dtype, 1, one),
        f"{name}C3": Encoding(dtype, 3, three),
    }


def _packed(name: str, pattern: str) -> dict[str, Encoding]:
    return {
        f"{name}10p": Encoding(np.uint8, 1.25, partial(_bit_stream, 10), pattern),
        f"{name}12p": Encoding(np.uint8, 1.5, partial(_bit_stream, 12), pattern),
        f"{name}10packed": Encoding(np.uint8, 1.5, partial(_gige_vision, 10), pattern),
        f"{name}12packed": Encoding(np.uint8, 1.5, partial(_gige_vision, 12), pattern),
    }


# By name; the first of each meaning is what `starpos` sends itself.
ENCODINGS: dict[str, Encoding] = {
    "mono8": Encoding(),
    "mono16": Encoding(np.uint16),
    "bgr8": Encoding(np.uint8, 3),
    **{f"bayer_{p}8": Encoding(pattern=p) for p in MOSAICS},
    **{f"bayer_{p}16": Encoding(np.uint16, pattern=p) for p in MOSAICS},
    **{
        f"{order}8": Encoding(np.uint8, len(order), partial(_to_bgr, f"COLOR_{order.upper()}2BGR"))
        for order in COLOURS
    },
    **{f"{order}16": Encoding(np.uint16, len(order), _mean) for order in COLOURS},
    "bgr16": Encoding(np.uint16, 3, _mean),
    **_of_type("8U", np.uint8, None, None),
    **_of_type("8S", np.int8, _signed, _signed_colours),
    **_of_type("16U", np.uint16, None, _mean),
    **_of_type("16S", np.int16, _signed, _signed_colours),
    **dict.fromkeys(("uyvy", "yuv422"), Encoding(np.uint8, 2, partial(_brightness, 1))),
    **dict.fromkeys(("yuyv", "yuv422_yuy2"), Encoding(np.uint8, 2, partial(_brightness, 0))),
    # the plane of brightness comes first
    **dict.fromkeys(("nv12", "nv21", "nv24"), Encoding()),
    **dict.fromkeys(("mono10", "mono12"), Encoding(np.uint16)),
    **_packed("mono", ""),
    **{name: e for p in MOSAICS for name, e in _packed(f"bayer{p[:2]}", p).items()},
}

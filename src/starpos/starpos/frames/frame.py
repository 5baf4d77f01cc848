# SPDX-License-Identifier: Apache-2.0
"""One exposure of a camera: its pixels and its time."""

from dataclasses import dataclass

import numpy as np

from starpos.errors import FrameError
from starpos.frames.exposure import Exposure, check_size
from starpos.frames.trail import Trail

# A header may claim any size; this many pixels fit into a small robot's memory.
MAX_PIXELS = 200_000_000
# Ratio to the noise above or below the sky from which a pixel is an error: no sensor has such a range.
LOUDEST = 30_000
PATTERNS = ("", "rggb", "bggr", "grbg", "gbrg")


@dataclass(frozen=True, eq=False)
class Frame(Exposure):
    """The pixels of one exposure, row 0 on top.

    pixels      (height, width) uint8 or uint16, grey or a colour mosaic; or (height, width, 3) uint8, BGR
    pattern     the mosaic's colours in reading order: 'rggb', 'bggr', 'grbg', 'gbrg'; '' for none
    trail       how its stars move during the exposure; None: unknown

    FrameError for other types, shapes, sizes or patterns.
    """

    pixels: np.ndarray
    pattern: str = ""
    trail: Trail | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        place, pixels = self.place, self.pixels
        if not isinstance(pixels, np.ndarray):
            raise FrameError(f"{place}: the pixels are a {type(pixels).__name__}; give a numpy array.")
        colour = pixels.ndim == 3 and pixels.shape[2] == 3
        if not (pixels.ndim == 2 or colour):
            raise FrameError(
                f"{place}: the pixels have the shape {pixels.shape}; give rows by columns, or by 3 as BGR."
            )
        if pixels.dtype != np.uint8 and (colour or pixels.dtype != np.uint16):
            depth = "uint8" if colour else "uint8 or uint16"
            raise FrameError(f"{place}: the pixels are {pixels.dtype}; convert them to {depth}.")
        check_size(pixels.shape[1], pixels.shape[0], place)
        if self.pattern not in PATTERNS or (colour and self.pattern):
            allowed = "''" if colour else ", ".join(map(repr, PATTERNS))
            raise FrameError(f"{place}: the colour pattern is {self.pattern!r}; it must be {allowed}.")

    def __repr__(self) -> str:
        return f"<{self.place}: {self.width} x {self.height} px, {self.pixels.dtype}>"

    @property
    def width(self) -> int:
        return self.pixels.shape[1]

    @property
    def height(self) -> int:
        return self.pixels.shape[0]


def to_unsigned(values: np.ndarray, place: str) -> np.ndarray:
    """Convert real values (h, w) to uint8 or uint16 by the rule of `reading.read_frame`; FrameError for other values."""
    if values.dtype.kind not in "uif":
        raise FrameError(f"{place}: its pixels are {values.dtype}; give numbers.")
    if values.size == 0:
        raise FrameError(f"{place}: it has no pixels; its shape is {values.shape}.")
    if values.dtype.kind == "u" and values.dtype.itemsize <= 2:
        return np.ascontiguousarray(values, values.dtype.newbyteorder("="))
    if values.dtype.kind == "f":
        finite = np.isfinite(values)
        if finite.mean() < 0.99:
            raise FrameError(f"{place}: more than 1 % of its pixels are NaN or infinite; mask fewer of them.")
        if not finite.all():
            values = np.where(finite, values, np.median(values[finite]))
    if not np.isfinite(float(values.max()) - float(values.min())):
        raise FrameError(
            f"{place}: its pixels span {values.min():g} to {values.max():g}; rescale them to 16 bits."
        )
    low, high = _limits(values)
    span = high - low
    narrow = values.dtype.kind == "f" and 0 < span < 4096
    if low >= 0 and high <= 65535 and not narrow:
        offset, scale = 0.0, 1.0
    else:
        offset, scale = low, (65535 / span if narrow or span > 65535 else 1.0)
    out = np.empty(values.shape, np.uint16)
    # in strips, because a float64 copy of a whole frame takes 170 MB
    for row in range(0, len(values), 256):
        strip = np.clip(values[row : row + 256].astype(np.float64), low, high)
        out[row : row + 256] = np.rint((strip - offset) * scale)
    return out


def _limits(values: np.ndarray) -> tuple[float, float]:
    """The smallest and the largest value, limited by LOUDEST.

    Without the limit a single pixel, divided by a dead pixel of the flat field, would take up all 16 bits.
    """
    low, high = float(values.min()), float(values.max())
    some = np.atleast_2d(values)[:: max(1, len(values) // 256)].astype(np.float64)
    noise = np.median(np.abs(np.diff(some, axis=1))) if some.shape[1] > 1 else 0.0
    if noise == 0:
        return low, high
    sky = float(np.median(some))
    return max(low, sky - LOUDEST * noise), min(high, sky + LOUDEST * noise)

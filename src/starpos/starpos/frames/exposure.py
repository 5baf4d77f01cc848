# SPDX-License-Identifier: Apache-2.0
"""Facts of an exposure besides its pixels: its time and length, how well both are known, and its source."""

from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from starpos.errors import FrameError
from starpos.frames.shutter import Shutter

# In a longer exposure the tilts of several poses would be averaged.
MAX_EXPOSURE_S = 3600.0
# A time known less well counts as unknown, and its square must not overflow.
MAX_STDDEV_S = 1e9
LARGEST_SIDE_PX = 1_000_000


@dataclass(frozen=True, eq=False, kw_only=True)
class Exposure:
    """One exposure of a camera; a `Frame` adds its pixels, `Stars` the stars found on it.

    mid_unix_s      middle of the exposure (of the row that is read first), UTC as a Unix time; None: unknown
    exposure_s      None: unknown
    source          where it came from, for messages: a path or a topic
    focal_px        focal length by the file's header (FOCALLEN / XPIXSZ), px; only a hint; None: unknown
    pixel_um        pixel size by the file's header (XPIXSZ), um; None: unknown
    rough_focal_px  focal length by the camera's EXIF, px: where a search for it begins; None: unknown
    fisheye         whether the camera's EXIF calls its lens a fisheye
    origin_px       column and row of the sensor's whole frame at which this one begins; NaN: an unknown part; None: not
                    stated to be a part
    stamp_stddev_s  standard deviation of mid_unix_s against the clock it was read from; 0: unknown
    clock_stddev_s  standard deviation of that clock against UTC, an error that all frames share; 0: unknown
    shutter         times of the rows; None: not stated
    untimed         why mid_unix_s is None, for messages; '': its file has no time

    FrameError if a time, a standard deviation or the focal length is an impossible number.
    """

    mid_unix_s: float | None = None
    exposure_s: float | None = None
    source: str = ""
    focal_px: float | None = None
    stamp_stddev_s: float = 0.0
    clock_stddev_s: float = 0.0
    shutter: Shutter | None = None
    rough_focal_px: float | None = None
    fisheye: bool = False
    pixel_um: float | None = None
    origin_px: tuple[float, float] | None = None
    untimed: str = ""

    def __post_init__(self) -> None:
        place = self.place
        if self.mid_unix_s is not None and not np.isfinite(self.mid_unix_s):
            raise FrameError(
                f"{place}: the time of the exposure's middle is {self.mid_unix_s}; give a Unix time or None."
            )
        if self.exposure_s is not None and not 0 <= self.exposure_s <= MAX_EXPOSURE_S:
            raise FrameError(
                f"{place}: the exposure is {self.exposure_s} s; give 0 to {MAX_EXPOSURE_S:g} s, or None where it "
                "is unknown."
            )
        for name in ("stamp_stddev_s", "clock_stddev_s"):
            value = getattr(self, name)
            if not 0 <= value <= MAX_STDDEV_S:
                raise FrameError(
                    f"{place}: {name} is {value}; it must be from 0 (unknown) to {MAX_STDDEV_S:g} s."
                )
        for focal_px in (self.focal_px, self.rough_focal_px):
            if focal_px is not None and not (np.isfinite(focal_px) and focal_px > 0):
                raise FrameError(
                    f"{place}: the focal length is {focal_px} px; give a positive number or None."
                )

    @property
    def place(self) -> str:
        """Name of the exposure in messages."""
        return self.source or "the frame"

    @property
    def about(self) -> dict[str, Any]:
        """The fields above by name, to make another object of the same exposure."""
        return {f.name: getattr(self, f.name) for f in fields(Exposure)}


def check_size(width: int, height: int, place: str) -> None:
    """Raise FrameError unless width and height are whole numbers of 1 to LARGEST_SIDE_PX pixels."""
    for name, value in (("width", width), ("height", height)):
        if not isinstance(value, (int, np.integer)) or not 1 <= value <= LARGEST_SIDE_PX:
            raise FrameError(
                f"{place}: the frame's {name} is {value!r}; it must be a whole number, 1 to {LARGEST_SIDE_PX} px."
            )

# SPDX-License-Identifier: Apache-2.0
"""The time and exposure that a camera writes into its own files (EXIF 2.31), and how well they are known.

A camera's clock is set by hand to the time of some zone, and often shows whole seconds only. So its time is used only if
a person has said how good the clock is (CameraClock).
"""

import io
import logging
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime, timezone
from typing import Any

from starpos.errors import FrameError, TimeError
from starpos.frames.header import MAX_EXPOSURE_S
from starpos.frames.shutter import UNKNOWN_LATENCY_S

# Canon and Nikon allow their clocks an error of a minute a month.
UNTENDED_STDDEV_S = 60.0
# UTC-12 to UTC+14 are in use.
ZONES_H = 14.0
# EXIF began then: a clock that shows an earlier year was never set.
FIRST_YEAR = 1996


@dataclass(frozen=True)
class CameraClock:
    """A camera's own clock; TimeError if a value is out of its range.

    utc_offset_h  the time it shows minus UTC, hours, east positive; None: as each file says (OffsetTimeOriginal)
    stddev_s      standard deviation of its error, which all frames share, s
    """

    utc_offset_h: float | None = None
    stddev_s: float = UNTENDED_STDDEV_S

    def __post_init__(self) -> None:
        if self.utc_offset_h is not None and not abs(self.utc_offset_h) <= ZONES_H:
            raise TimeError(
                f"a camera's clock {self.utc_offset_h:g} h from UTC is of no zone: give -{ZONES_H:g} to {ZONES_H:g} h"
            )
        if not 0 <= self.stddev_s <= 86400:
            raise TimeError(f"a camera's clock is known to {self.stddev_s:g} s: give 0 to 86400 s")


def told(data: bytes, place: str, clock: CameraClock | None) -> dict[str, Any]:
    """Read from the EXIF of a TIFF, JPEG, PNG or TIFF-like raw file (DNG, CR2, NEF ...) what a Frame has fields for.

    exposure_s comes from ExposureTime. With a clock also mid_unix_s, stamp_stddev_s and clock_stddev_s: DateTimeOriginal
    and SubSecTimeOriginal are the start of the exposure, rounded down; when the shutter opened is known less well.
    FrameError if these exist but are not a time.
    """
    try:
        import exifread
    except ImportError:
        if clock is None:
            return {}
        raise FrameError(f"{place}: reading EXIF needs exifread; run `pip install exifread`.") from None
    # it warns about every file without EXIF
    logging.getLogger("exifread").setLevel(logging.CRITICAL)
    try:
        tags = exifread.process_file(io.BytesIO(data), details=False)
    # damaged bytes make it raise any kind of exception
    except Exception:
        tags = {}
    exposure_s = _exposure_s(tags)
    known: dict[str, Any] = {} if exposure_s is None else {"exposure_s": exposure_s}
    if clock is None or exposure_s is None or "EXIF DateTimeOriginal" not in tags:
        return known
    start_unix_s, step_s = _start(tags, place, clock)
    return known | {
        "mid_unix_s": start_unix_s + exposure_s / 2,
        "stamp_stddev_s": math.hypot(step_s / math.sqrt(12), UNKNOWN_LATENCY_S),
        "clock_stddev_s": clock.stddev_s,
    }


def _exposure_s(tags: Mapping) -> float | None:
    """ExposureTime in s; None if it is missing or impossible."""
    try:
        ratio = tags["EXIF ExposureTime"].values[0]
        seconds = ratio.num / ratio.den
    except (LookupError, TypeError, AttributeError, ArithmeticError):
        return None
    return seconds if 0 < seconds <= MAX_EXPOSURE_S else None


def _start(tags: Mapping, place: str, clock: CameraClock) -> tuple[float, float]:
    """Unix time of the exposure's start (middle of the clock's last step before it), and the length of a step (s)."""
    text = _text(tags, "DateTimeOriginal")
    try:
        shown = datetime.strptime(text, "%Y:%m:%d %H:%M:%S")
    except ValueError:
        shown = datetime.min
    if shown.year < FIRST_YEAR:
        raise FrameError(
            f"{place}: its EXIF was taken at {text!r}, which is no time: set the camera's clock."
        )
    offset_h = clock.utc_offset_h
    if offset_h is None:
        zone = _text(tags, "OffsetTimeOriginal")
        parts = re.fullmatch(r"([+-])(\d\d):(\d\d)", zone)
        if not parts:
            raise FrameError(
                f"{place}: its EXIF has no zone (OffsetTimeOriginal is {zone!r}): say by how many hours the camera's "
                "clock is before UTC."
            )
        offset_h = float(parts[1] + "1") * (int(parts[2]) + int(parts[3]) / 60)
    digits = _text(tags, "SubSecTimeOriginal")
    # many cameras that count no fractions write zeros
    if not re.fullmatch(r"\d{1,9}", digits) or not int(digits):
        digits = ""
    step_s = 10.0 ** -len(digits)
    whole = shown.replace(tzinfo=timezone.utc).timestamp() - 3600 * offset_h
    return whole + (int(digits or 0) + 0.5) * step_s, step_s


def _text(tags: Mapping, name: str) -> str:
    """The text of a tag without padding; empty if the tag is missing."""
    value = getattr(tags.get(f"EXIF {name}"), "values", "")
    return value.replace("\0", " ").strip() if isinstance(value, str) else ""

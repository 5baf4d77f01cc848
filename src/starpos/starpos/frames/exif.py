# SPDX-License-Identifier: Apache-2.0
"""What a camera writes into its own files (EXIF 2.31): time, exposure, focal length, and how well they are known.

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
from starpos.frames.exposure import MAX_EXPOSURE_S, UNKNOWN_LATENCY_S

# Canon and Nikon allow their clocks an error of a minute a month.
UNTENDED_STDDEV_S = 60.0
# UTC-12 to UTC+14 are in use.
ZONES_H = 14.0
# EXIF began then: a clock that shows an earlier year was never set.
FIRST_YEAR = 1996
# Diagonal of a 35 mm film's frame of 36 x 24 mm.
FILM_MM = 43.267
# Units of FocalPlaneResolutionUnit in mm: inch, cm, mm, um.
UNITS_MM = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}
# A zone is a multiple of this. GPS gives the time of its last fix, and a camera's clock is off by less than half of it.
ZONE_STEP_S, GPS_APART_S = 900.0, 450.0
# Sides of a picture over those that the camera made: both alike, or it was cropped, but for rounding.
SAME_SHAPE = 0.02
# A lens, or a camera with its lens, that is called a fisheye: "EF8-15mm f/4L FISHEYE USM", "AF Fish-Eye-Nikkor 16mm".
FISHEYE = re.compile(r"fish[ _-]?eye", re.IGNORECASE)
NAMES = ("EXIF LensModel", "EXIF LensMake", "Image Model", "Image Make")
# Limits of the focal length over the frame's diagonal, beyond any lens.
SHORTEST, LONGEST = 0.1, 1000.0


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


def told(data: bytes, place: str, clock: CameraClock | None, shape: tuple[int, ...]) -> dict[str, Any]:
    """Read from the EXIF of a TIFF, JPEG, PNG or TIFF-like raw file (DNG, CR2, NEF ...) what a Frame has fields for.

    shape: of the pixels, rows first. exposure_s comes from ExposureTime, rough_focal_px from
    FocalLengthIn35mmFilm, else from FocalLength and FocalPlaneXResolution; fisheye from the names of lens and camera;
    origin_px is NaN if the picture has another shape than the camera gave it (ExifImageWidth, ExifImageLength). With a
    clock also mid_unix_s, stamp_stddev_s and clock_stddev_s, or untimed: DateTimeOriginal and SubSecTimeOriginal are the
    start of the exposure, rounded down; when the shutter opened is known less well. FrameError if exifread is missing
    where a clock asks for it.
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
    known["rough_focal_px"] = _focal_px(tags, shape[1], shape[0])
    known["fisheye"] = any(FISHEYE.search(_text(tags, name)) for name in NAMES)
    if _cropped(tags, shape[1], shape[0]):
        known["origin_px"] = (math.nan, math.nan)
    if clock is None:
        return known
    if exposure_s is None or "EXIF DateTimeOriginal" not in tags:
        lacks = "ExposureTime" if exposure_s is None else "DateTimeOriginal"
        return known | {"untimed": f"its EXIF has no {lacks}: give the file as the camera wrote it"}
    try:
        start_unix_s, step_s = _start(tags, clock)
    except TimeError as e:
        return known | {"untimed": str(e)}
    return known | {
        "mid_unix_s": start_unix_s + exposure_s / 2,
        "stamp_stddev_s": math.hypot(step_s / math.sqrt(12), UNKNOWN_LATENCY_S),
        "clock_stddev_s": clock.stddev_s,
    }


def _exposure_s(tags: Mapping) -> float | None:
    """ExposureTime in s; None if it is missing or impossible."""
    seconds = _number(tags, "ExposureTime")
    return seconds if seconds is not None and seconds <= MAX_EXPOSURE_S else None


def _cropped(tags: Mapping, width: int, height: int) -> bool:
    """Whether a picture of this size has another shape than the one that the camera made, in either orientation."""
    made = sorted(_number(tags, name) or 0.0 for name in ("ExifImageWidth", "ExifImageLength"))
    return made[0] > 0 and abs(made[0] / made[1] * max(width, height) / min(width, height) - 1) > SAME_SHAPE


def _focal_px(tags: Mapping, width: int, height: int) -> float | None:
    """About the focal length in px of a picture of this size, as the whole sensor makes one; None if unknown."""
    film_mm, focal_mm = _number(tags, "FocalLengthIn35mmFilm"), _number(tags, "FocalLength")
    per_unit, unit = (_number(tags, f"FocalPlane{name}") for name in ("XResolution", "ResolutionUnit"))
    diagonal_px = math.hypot(width, height)
    focal_px = None
    if film_mm is not None:
        focal_px = film_mm / FILM_MM * diagonal_px
    elif focal_mm is not None and per_unit is not None:
        # the resolution is of the picture as the camera made it, which may have been reduced since
        made = max(_number(tags, name) or 0.0 for name in ("ExifImageWidth", "ExifImageLength"))
        reduced = max(width, height) / made if made else 1.0
        focal_px = focal_mm * per_unit / UNITS_MM.get(int(unit or 2), UNITS_MM[2]) * reduced
    if focal_px is None or not SHORTEST * diagonal_px < focal_px < LONGEST * diagonal_px:
        return None
    return focal_px


def _number(tags: Mapping, name: str) -> float | None:
    """The positive number that is a tag's first value; None if it is missing or another thing."""
    try:
        value = tags[f"EXIF {name}"].values[0]
        number = value.num / value.den if hasattr(value, "den") else float(value)
    except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError):
        return None
    return number if 0 < number < math.inf else None


def _start(tags: Mapping, clock: CameraClock) -> tuple[float, float]:
    """Unix time of the exposure's start (middle of the clock's last step before it), and the length of a step (s).

    The zone is the clock's, else OffsetTimeOriginal's, else by GPS's time; TimeError if there is no time, no zone,
    or if GPS contradicts it.
    """
    text = _text(tags, "EXIF DateTimeOriginal")
    try:
        shown = datetime.strptime(text, "%Y:%m:%d %H:%M:%S")
    except ValueError:
        shown = datetime.min
    if shown.year < FIRST_YEAR:
        raise TimeError(f"its EXIF was taken at {text!r}, which is no time: set the camera's clock")
    shown_s = shown.replace(tzinfo=timezone.utc).timestamp()
    ahead_s = None if (gps_s := _gps_unix_s(tags)) is None else shown_s - gps_s
    offset_s, zone = _stated_offset_s(tags, clock), _text(tags, "EXIF OffsetTimeOriginal")
    if offset_s is None and ahead_s is not None and abs(ahead_s) <= 3600 * ZONES_H + GPS_APART_S:
        offset_s = round(ahead_s / ZONE_STEP_S) * ZONE_STEP_S
    if offset_s is None:
        raise TimeError(
            f"its EXIF has no zone (OffsetTimeOriginal is {zone!r}) and no time by GPS: say "
            "by how many hours the camera's clock is before UTC"
        )
    if ahead_s is not None and abs(ahead_s - offset_s) > GPS_APART_S:
        raise TimeError(
            f"by the GPS time in its EXIF the camera's clock was {ahead_s / 3600:.2f} h ahead of UTC, and not "
            f"{offset_s / 3600:g} h: state the zone that it showed, or set it"
        )
    digits = _text(tags, "EXIF SubSecTimeOriginal")
    # many cameras that count no fractions write zeros
    if not re.fullmatch(r"\d{1,9}", digits) or not int(digits):
        digits = ""
    step_s = 10.0 ** -len(digits)
    return shown_s - offset_s + (int(digits or 0) + 0.5) * step_s, step_s


def _stated_offset_s(tags: Mapping, clock: CameraClock) -> float | None:
    """Time in s by which the camera's clock was ahead of UTC, by the user or by the file; None if neither says it."""
    if clock.utc_offset_h is not None:
        return 3600 * clock.utc_offset_h
    parts = re.fullmatch(r"([+-])(\d\d):(\d\d)", _text(tags, "EXIF OffsetTimeOriginal"))
    return float(parts[1] + "1") * (3600 * int(parts[2]) + 60 * int(parts[3])) if parts else None


def _gps_unix_s(tags: Mapping) -> float | None:
    """GPSDateStamp and GPSTimeStamp, UTC of the last fix, as a Unix time; None if missing or invalid."""
    try:
        day = datetime.strptime(str(tags["GPS GPSDate"].values).strip("\0 "), "%Y:%m:%d")
        hours, minutes, seconds = (value.num / value.den for value in tags["GPS GPSTimeStamp"].values)
    except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError):
        return None
    if not (0 <= hours < 24 and 0 <= minutes < 60 and 0 <= seconds <= 60):
        return None
    return day.replace(tzinfo=timezone.utc).timestamp() + 3600 * hours + 60 * minutes + seconds


def _text(tags: Mapping, name: str) -> str:
    """The text of a tag without padding, by its name in exifread; empty if the tag is missing."""
    value = getattr(tags.get(name), "values", "")
    return value.replace("\0", " ").strip() if isinstance(value, str) else ""

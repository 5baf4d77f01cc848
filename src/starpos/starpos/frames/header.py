# SPDX-License-Identifier: Apache-2.0
"""Time, exposure and focal length from a frame's header.

A header is a mapping of FITS keywords (those of KEYS) to values of any kind; every value is checked.
"""

import math
import re
import warnings
from collections.abc import Mapping
from typing import Any

import erfa
import numpy as np

from starpos.errors import FrameError
from starpos.frames.shutter import Shutter
from starpos.units import DAY_S
from starpos.utc import UNIX_EPOCH_JD

START = ("DATE-OBS", "DATE-BEG", "MJD-OBS", "MJD-BEG")
KEYS = (
    *START,
    "TIME-OBS",
    "TIMESYS",
    "EXPTIME",
    "EXPOSURE",
    "BAYERPAT",
    "XBAYROFF",
    "YBAYROFF",
    "FOCALLEN",
    "XPIXSZ",
    "ROLLSHUT",
)
# Time scales of TIMESYS that are read; UT1 would need tables.
SCALES = ("utc", "tai", "tt", "tdb")
MAX_EXPOSURE_S = 86400.0
ISO_TIME = re.compile(r"(\d{4})-(\d\d)-(\d\d)T(\d\d):(\d\d)(?::(\d\d?(?:\.\d*)?))?Z?", re.ASCII)
MJD_ZERO_JD, FARTHEST_MJD = 2400000.5, 1e7
# an MJD's last digit counts from here: below it lie the last bits of a double
LEAST_MJD_STEP_S = 1e-3


def times(header: Mapping, place: str) -> tuple[float | None, float | None, float]:
    """Middle of the exposure (Unix time), its length (s), and the standard deviation (s) of the middle.

    The first two are None if the header has none. The standard deviation comes from the last digit of the time, which may
    be rounded or cut off. FrameError for a bad time or exposure; place names the frame in its message.
    """
    exposure = next((header[k] for k in ("EXPTIME", "EXPOSURE") if header.get(k) not in (None, "")), None)
    if exposure is not None:
        try:
            exposure = float(exposure)
        except (TypeError, ValueError, OverflowError):
            exposure = np.nan
        if not 0 <= exposure <= MAX_EXPOSURE_S:
            raise FrameError(
                f"{place}: its exposure (EXPTIME) is not 0 to {MAX_EXPOSURE_S:.0f} s; correct the header."
            )
    key = next((k for k in START if header.get(k) not in (None, "")), None)
    if key is None or exposure is None:
        return None, exposure, 0.0
    start = _as_today(header[key])
    if key == "DATE-OBS" and "T" not in str(start) and header.get("TIME-OBS"):
        start = f"{start}T{header['TIME-OBS']}"
    # a day without an hour is not a time
    if isinstance(start, str) and re.fullmatch(r"\d{4}-\d\d-\d\d", start):
        return None, exposure, 0.0
    scale = str(header.get("TIMESYS", "UTC")).strip().lower()
    if scale not in SCALES:
        raise FrameError(f"{place}: its TIMESYS is {scale!r}; it must be one of {', '.join(SCALES)}.")
    # a number of another keyword (a Julian date, Unix time) would pass for an MJD
    if not isinstance(start, str) and not key.startswith("MJD"):
        raise FrameError(
            f"{place}: its {key} is {start!r}, which is no text; write it like 2026-11-02T18:00:00.000."
        )
    return _middle(start, exposure, scale, f"{place}: its {key}"), exposure, _rounding(start)


def _as_today(start: Any) -> Any:
    """Text as FITS wants it today, of a day of the 20th century as FITS had it before 1999, or with a space for the T."""
    if not isinstance(start, str):
        return start
    text = re.sub(r"^(\d\d)/(\d\d)/(\d\d)(?!\d)", r"19\3-\2-\1", start.strip())
    return re.sub(r"^(\d{4}-\d\d-\d\d) +(?=\d\d:)", r"\1T", text)


def _rounding(start: Any) -> float:
    """Standard deviation (s) from the last digit of a text or an MJD, rounded or cut off; 0 of an MJD with many."""
    if not isinstance(start, str):
        digits = repr(float(start)).partition(".")[2].rstrip("0")
        sigma_s = DAY_S * 10.0 ** -len(digits) / math.sqrt(3)
        return sigma_s if sigma_s > LEAST_MJD_STEP_S else 0.0
    decimals = re.search(r":\d\d:\d\d(?:\.(\d*))?", start)
    # a time without seconds
    if decimals is None:
        return 60 / math.sqrt(3)
    return 10.0 ** -len(decimals[1] or "") / math.sqrt(3)


def _middle(start: Any, exposure_s: float, scale: str, what: str) -> float:
    """Unix time of start (ISO 8601 text or an MJD) + exposure / 2, added in TAI: right across a leap second too.

    By ERFA alone: astropy's times, which are ERFA's, take as long to import as the rest of a program's start.
    """
    try:
        with warnings.catch_warnings():
            # of years whose leap seconds nobody knows
            warnings.simplefilter("ignore", erfa.ErfaWarning)
            day, part = _tai(*_day_of(start, scale), scale)
            day, part = erfa.taiutc(day, part + exposure_s / 2 / DAY_S)
    except (erfa.ErfaError, ValueError, TypeError, OverflowError):
        raise FrameError(
            f"{what} is {start!r}, which is no time; write it like 2026-11-02T18:00:00.000."
        ) from None
    return float((day - UNIX_EPOCH_JD) * DAY_S + part * DAY_S)


def _day_of(start: Any, scale: str) -> tuple[float, float]:
    """Julian date of a time in its scale, in two parts: ERFA's quasi-JD where that is UTC; ValueError for no time."""
    if not isinstance(start, str):
        if not abs(start := float(start)) < FARTHEST_MJD:
            raise ValueError(start)
        return MJD_ZERO_JD, start
    found = ISO_TIME.fullmatch(start.strip())
    if found is None:
        raise ValueError(start)
    *whole, seconds = found.groups()
    return tuple(erfa.dtf2d(scale.upper(), *map(int, whole), float(seconds or 0)))


def _tai(day: float, part: float, scale: str) -> tuple[float, float]:
    """The Julian date in TAI of one in another scale, each in two parts."""
    if scale == "tai":
        return day, part
    if scale == "utc":
        return tuple(erfa.utctai(day, part))
    if scale == "tdb":
        # at the geocentre; the time of day has no part in it there
        day, part = erfa.tdbtt(day, part, erfa.dtdb(day, part, 0.0, 0.0, 0.0, 0.0))
    return tuple(erfa.tttai(day, part))


def shutter(header: Mapping, place: str) -> Shutter | None:
    """The shutter by ROLLSHUT, s from the row that is read first to the last, negative where the bottom row is first.

    0 is a global shutter; None if the header has no ROLLSHUT. FrameError for a bad one.
    """
    if (readout := header.get("ROLLSHUT")) in (None, ""):
        return None
    try:
        return Shutter(float(readout), 0.0)
    except (TypeError, ValueError, OverflowError, FrameError):
        raise FrameError(
            f"{place}: its ROLLSHUT is no time from the first row to the last in s; correct the header."
        ) from None


def focal_px(header: Mapping) -> float | None:
    """Focal length in px, FOCALLEN (mm) / XPIXSZ (um); None if one is missing or impossible. It is only a hint."""
    try:
        focal = float(header["FOCALLEN"]) * 1000.0 / float(header["XPIXSZ"])
    except (KeyError, TypeError, ValueError, ArithmeticError):
        return None
    return focal if np.isfinite(focal) and focal > 0 else None


def focal_mm(focal_px: float, pixel_um: float) -> float:
    """FOCALLEN, mm, of a focal length in px and pixels of so many um."""
    # so many digits make 29.67 of 29.669999999999998
    return float(f"{focal_px * pixel_um / 1000:.12g}")

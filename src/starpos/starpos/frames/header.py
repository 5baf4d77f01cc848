# SPDX-License-Identifier: Apache-2.0
"""What a frame's header says of its exposure: time, focal length, shutter, and the place of a crop on the sensor.

A header is a mapping of FITS keywords (KEYS) to values of any kind; every value is checked. Its cards of start,
middle, end and length are compared, with other cards of UTC and with their comments: those that contradict each other
give no time, and a length of 0 is unknown. Without a time `untimed` says why.
"""

import itertools
import math
import re
import warnings
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import erfa

from starpos.errors import FrameError, TimeError, one_line
from starpos.frames.exposure import MAX_EXPOSURE_S, UNKNOWN_LATENCY_S, Exposure, Shutter
from starpos.tables import packaged
from starpos.units import ARCSEC, DAY_S, UNIX_EPOCH_JD

# by what they state, as data/cards.csv explains
CARDS = {row["stated"]: tuple(row["keywords"].split()) for row in packaged("starpos.frames", "cards.csv")}
KEYS = tuple(itertools.chain.from_iterable(CARDS.values()))
START, MIDDLE, END = CARDS["start"], CARDS["middle"], CARDS["end"]
HOURS, DATES, LENGTHS = CARDS["hours"], CARDS["dates"], CARDS["length"]
STACKED = re.compile(r"\b(master *(light)?|stack(ed)?|integration|co-?add(ed)?|sum(med)?)\b", re.IGNORECASE)
# Time scales of TIMESYS that are read; UT1 would need tables.
TIME_SCALES = ("utc", "tai", "tt", "tdb", "gps")
GPS_BEHIND_TAI_S = 19.0
# Units in the comment of a length, in brackets as FITS has them, or in TIMEUNIT; the length is in s without one.
UNITS_S = {"us": 1e-6, "ms": 1e-3, "msec": 1e-3, "s": 1.0, "sec": 1.0, "second": 1.0, "seconds": 1.0, "min": 60.0,
           "h": 3600.0, "d": 86400.0}  # fmt: skip
# What the comment of a start may say. Names of zones count in capitals only.
UNIVERSAL = re.compile(r"\b(utc?|gmt|universal)\b(?! *[+-] *\d)", re.IGNORECASE)
OFFSET = re.compile(r"\b(?:utc?|gmt) *[+-] *0*[1-9]", re.IGNORECASE)
ZONE = re.compile(
    r"\b(CES?T|MES?Z|EES?T|WEST|BST|MSK|[ECMP][SD]T|AK[SD]T|HST|[IJK]ST|A[ECW][SD]T|NZ[SD]T|SAST|BRT|ART|CLS?T)\b"
)
LOCALLY = re.compile(r"\b(local|civil|wall.?clock)\b", re.IGNORECASE)
OPENING = re.compile(r"\b(start|begin|beginning|open(ing)?)\b", re.IGNORECASE)
CENTRE = re.compile(r"\b(mid|middle|midpoint|cent(er|re))\b", re.IGNORECASE)
CLOSING = re.compile(r"\b(end|ending|finish|stop|closed?|closing|frame grabbed)\b", re.IGNORECASE)
CREATED = re.compile(r"\b(image created|file (created|written))\b", re.IGNORECASE)
# ahead of UTC
OTHER_SCALE_S = {"GPS": 18, "TAI": 37, "TT": 69}
OTHER_SCALE = re.compile(r"\b(GPS|TAI|TT)\b", re.IGNORECASE)
# Cards of the UTC of some moment of the exposure may be off by the time in which a header is written. Up to FOUND_S the
# difference is an error of the stamp; a larger one is another time, as a local one is.
WRITING_S, FOUND_S = 5.0, 90.0
QUARTER_S = 900.0
NO_COMMENTS: Mapping[str, str] = {}
# Cards that set the middle of the exposure farther apart than this, beyond their rounding, contradict each other.
MAX_APART_S = 0.5
ISO_TIME = re.compile(r"(\d{4})-(\d\d)-(\d\d)T(\d\d):(\d\d)(?::(\d\d?(?:\.\d*)?))?Z?", re.ASCII)
DAY = re.compile(r"\d{4}-\d\d-\d\d", re.ASCII)
MJD_ZERO_JD, FARTHEST_MJD = 2400000.5, 1e7
CLOCK = re.compile(r"(\d\d?):(\d\d)(?::(\d\d(?:\.\d*)?))?", re.ASCII)
# numbers above these are MJDs of the space age, Julian dates, Unix times of this century; a number of GPS counts from an
# epoch of its own, or a week's
LEAST_MJD, MOST_MJD, LEAST_JD, LEAST_UNIX_S = 3e4, 1e5, 2.43e6, 9e8
# smallest step of an MJD's last digit: below it lie the last bits of a double
MIN_MJD_STEP_S = 1e-3
# minimum of a focal length, a pixel or a scale that counts as stated
LEAST = 1e-9


def read_exposure(header: Mapping, place: str, comments: Mapping[str, str] = NO_COMMENTS) -> Exposure:
    """Read the Exposure that a header states; FrameError for a bad shutter. place names it in messages.

    comments: of cards, by their keywords.
    """
    return replace(
        read_times(header, comments),
        source=place,
        focal_px=focal_px(header),
        pixel_um=_positive(header, "XPIXSZ"),
        shutter=shutter(header, place),
        origin_px=origin_px(header),
        aim_deg=aim_deg(header),
        **site(header),
    )


def _stated(header: Mapping, keys: Iterable[str]) -> list[str]:
    """Choose the cards that a header has with a value, from some."""
    return [key for key in keys if header.get(key) not in (None, "")]


def aim_deg(header: Mapping) -> tuple[float, float] | None:
    """Right ascension and declination (deg) to which a header says that the telescope was pointed; None without.

    A number is in deg, a text with colons or blanks in h m s and in deg ' ".
    """
    for keys in zip(CARDS["right_ascension"], CARDS["declination"], strict=True):
        right, up = (_sexagesimal(header.get(key)) for key in keys)
        if right is not None and up is not None:
            (ra, in_hours), (dec, _) = right, up
            if 0 <= (ra := ra * 15 if in_hours else ra) <= 360 and abs(dec) <= 90:
                return ra, dec
    return None


def _sexagesimal(value: Any) -> tuple[float, bool] | None:
    """A number, and whether it was written in three parts; None for any other text."""
    parts = re.split(r"[: hdms]+", str(value).strip(" hdms"))
    try:
        sizes = [abs(float(part)) for part in parts]
    except ValueError:
        return None
    size = sum(part / 60**k for k, part in enumerate(sizes))
    if not math.isfinite(size):
        return None
    return -size if parts[0].startswith("-") else size, len(parts) > 1


def site(header: Mapping) -> dict[str, Any]:
    """An Exposure's site_cards and site_deg by the first cards that state a site; programs leave 0, 0 for none."""
    for keys in zip(CARDS["latitude"], CARDS["longitude"], strict=True):
        latitude, longitude = (_coordinate_deg(header.get(key)) for key in keys)
        if abs(latitude) <= 90 and abs(longitude) <= 360 and (latitude or longitude):
            cards = " and ".join(f"{key} {one_line(header[key])}" for key in keys)
            return {"site_cards": cards, "site_deg": (latitude, longitude)}
    return {}


def _coordinate_deg(value: Any) -> float:
    """A latitude or a longitude, of which S and W are negative; NaN for another text."""
    text = str(value).strip()
    found = _sexagesimal(text.strip("NSEW "))
    if found is None:
        return math.nan
    return -found[0] if text[-1:] in "SW" or text[:1] in "SW" else found[0]


def origin_px(header: Mapping) -> tuple[float, float] | None:
    """Column and row of the sensor's frame at which a frame begins; None if nothing says so, NaN for no numbers."""
    for begins, sign in (("", 1.0), ("minus_", -1.0)):
        keys = CARDS[f"{begins}left"] + CARDS[f"{begins}top"]
        if _stated(header, keys):
            with suppress(TypeError, ValueError, OverflowError):
                left, top = (sign * float(header.get(key) or 0) for key in keys)
                scales = [float(header.get(key) or 1) for key in CARDS["minus_scale"] if sign < 0]
                if math.isfinite(left) and math.isfinite(top) and all(scale == 1 for scale in scales):
                    return left + 0.0, top + 0.0
            return math.nan, math.nan
    return None


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


def fwhm_px(header: Mapping) -> float | None:
    """Width of the star images (px) by the FWHM of a list of stars; None if it has none."""
    return _positive(header, "FWHM")


def focal_px(header: Mapping) -> float | None:
    """Focal length in px by FOCALLEN (mm) / XPIXSZ (um), else by a plate scale; None if nothing says it. Only a hint."""
    focal, pixel_um = _positive(header, "FOCALLEN"), _positive(header, "XPIXSZ")
    if focal is not None and pixel_um is not None:
        return focal * 1000.0 / pixel_um
    scales = (_positive(header, key) for key in CARDS["plate_scale"])
    return next((1.0 / (scale * ARCSEC) for scale in scales if scale is not None), None)


def _positive(header: Mapping, key: str) -> float | None:
    """A number above LEAST; None for anything else."""
    with suppress(KeyError, TypeError, ValueError, OverflowError):
        if LEAST < (value := float(header[key])) < math.inf:
            return value
    return None


def focal_mm(focal_px: float, pixel_um: float) -> float:
    """FOCALLEN, mm, from a focal length in px and the size of a pixel in um."""
    # 12 digits turn 29.669999999999998 into 29.67
    return float(f"{focal_px * pixel_um / 1000:.12g}")


@dataclass(frozen=True)
class _Moment:
    """A moment by some cards: s in TAI since 1970, and its standard deviation by its last digit.

    As differences are formed in TAI, exposures across a leap second come out right.
    """

    tai_s: float
    stddev_s: float
    by: str


def read_times(header: Mapping, comments: Mapping[str, str] = NO_COMMENTS) -> Exposure:
    """Read when a frame was exposed: mid_unix_s, exposure_s, stamp_stddev_s, or untimed.

    comments: of cards, by their keywords.

    stamp_stddev_s comes from the last digit of a time, which may be rounded or cut off, and from how far cards that
    should agree are apart. A header without any card of a time has an empty untimed.
    """
    exposure_s = None
    try:
        _check_single(header)
        lengths = _lengths(header, comments)
        exposure_s = next(iter(lengths.values()), None)
        header = _as_commented(header, comments)
        moments = _moments(header)
        middles = _middles(moments, lengths)
        if not middles:
            return Exposure(exposure_s=exposure_s, untimed=_no_length(header) if moments else "")
        best = min(middles, key=lambda m: m.stddev_s)
        other = max(middles, key=lambda m: _apart_s(m, best))
        if (apart_s := _apart_s(other, best)) > MAX_APART_S:
            exposure_s = None
            raise TimeError(
                f"the middle of its exposure by {best.by} and by {other.by} differ by "
                f"{abs(other.tai_s - best.tai_s):.3g} s: these cards contradict each other, correct the header"
            )
        if exposure_s is None:
            exposure_s = _span_s(moments)
        mid_unix_s = _unix_s(best.tai_s)
        off_s = _off_others_s(header, mid_unix_s, exposure_s or 0.0)
        _check_zone(header, mid_unix_s, exposure_s or 0.0)
        _check_written(header, mid_unix_s)
    except TimeError as e:
        return Exposure(exposure_s=exposure_s, untimed=str(e))
    return Exposure(
        mid_unix_s=mid_unix_s, exposure_s=exposure_s, stamp_stddev_s=math.hypot(best.stddev_s, apart_s, off_s)
    )


def _as_commented(header: Mapping, comments: Mapping[str, str]) -> Mapping:
    """The header with its start as the comment calls it: the middle or the end; TimeError for a time that is not UTC."""
    values = dict(header)
    for key in _stated(header, START):
        comment = comments.get(key, "")
        local = OFFSET.search(comment) or ZONE.search(comment) or LOCALLY.search(comment)
        if local and not UNIVERSAL.search(comment):
            raise TimeError(
                f"its {key} is a local time by its comment ({one_line(comment)}): write UTC into it"
            )
        if CREATED.search(comment):
            raise TimeError(
                f"its {key} is when the file was made by its comment ({one_line(comment)}): write the start of the "
                "exposure into it"
            )
        scale = OTHER_SCALE.search(comment)
        if scale and not UNIVERSAL.search(comment) and not values.get("TIMESYS"):
            name = scale[1].upper()
            raise TimeError(
                f"its {key} may be {name} time by its comment ({one_line(comment)}), {OTHER_SCALE_S[name]} s ahead of "
                f"UTC: add a card TIMESYS with {name} or UTC"
            )
        if OPENING.search(comment):
            continue
        kind = MIDDLE if CENTRE.search(comment) else END if CLOSING.search(comment) else None
        if kind is not None:
            values.setdefault(kind[key.startswith("MJD")], values.pop(key))
    return values


def _off_others_s(header: Mapping, mid_unix_s: float, exposure_s: float) -> float:
    """The time in s by which other cards of UTC lie outside the exposure; TimeError if it is another time."""
    off_s = 0.0
    for key in (*HOURS, *DATES):
        other = _other_unix_s(header, key, mid_unix_s)
        if other is None:
            continue
        at_unix_s, step_s = other
        gap_s = abs(at_unix_s - mid_unix_s) - exposure_s / 2 - step_s - WRITING_S
        if gap_s > FOUND_S:
            raise TimeError(_other_time(key, at_unix_s - mid_unix_s))
        off_s = max(off_s, gap_s)
    return off_s


def _other_time(key: str, later_s: float) -> str:
    """The sentence on a card whose time is later than the exposure by that much."""
    hours = later_s / 3600
    local = abs(math.remainder(later_s, QUARTER_S)) < FOUND_S and abs(hours) < 15
    return (
        f"its {key} is {hours:+.2f} h from the exposure by its other cards"
        + (": one of them is a local time" if local else ": these cards contradict each other")
        + ", correct the header"
    )


def _other_unix_s(header: Mapping, key: str, near_unix_s: float) -> tuple[float, float] | None:
    """The Unix time of a card of UTC, and the step of its last digit in s; None if it is not a time.

    A time of day is of the day that is nearest to near_unix_s.
    """
    value = header.get(key)
    if value in (None, "") or isinstance(value, bool):
        return None
    try:
        if isinstance(value, str) and (text := _as_today(value)) and ISO_TIME.fullmatch(text):
            return _unix_s(_tai_s(text, "utc")), math.sqrt(3) * _rounding(text)
        if isinstance(value, str) and (clock := CLOCK.fullmatch(value.strip())):
            hours, minutes, seconds = clock.groups()
            of_day_s = int(hours) * 3600 + int(minutes) * 60 + float(seconds or 0)
            step_s = math.sqrt(3) * _rounding(f"T{value.strip()}") if seconds else 60.0
            later_s = math.remainder(of_day_s - near_unix_s, DAY_S)
            return near_unix_s + later_s, step_s
        number = float(value)
    except (TypeError, ValueError, OverflowError):
        return None
    # a Unix time, a Julian date or an MJD, by its size
    if key not in DATES or key.startswith("GPS") or not math.isfinite(number):
        return None
    if number > LEAST_UNIX_S:
        return number, 1.0
    if not (LEAST_MJD < number < MOST_MJD or LEAST_JD < number < LEAST_JD + MOST_MJD):
        return None
    zero_jd = UNIX_EPOCH_JD if number > LEAST_JD else UNIX_EPOCH_JD - MJD_ZERO_JD
    return (number - zero_jd) * DAY_S, math.sqrt(3) * _rounding(number) + 1.0


def _check_zone(header: Mapping, mid_unix_s: float, exposure_s: float) -> None:
    """TimeError if the time of the exposure may be the local one of the header's zone."""
    zone = next(iter(_stated(header, CARDS["zone"])), "")
    offset_h = _offset_h(header.get(zone))
    if not offset_h:
        return
    if any(_other_unix_s(header, key, mid_unix_s) is not None for key in (*HOURS, *DATES)):
        return
    for key in CARDS["local"]:
        if (local := _other_unix_s(header, key, mid_unix_s)) is not None:
            if abs(local[0] - mid_unix_s) > exposure_s + FOUND_S:
                return
            raise TimeError(
                f"its time of exposure is its local time ({key}), {offset_h:+g} h from UTC by its {zone}: write UTC into "
                "DATE-OBS"
            )
    raise TimeError(
        f"its {zone} is {offset_h:+g} h, and no card shows whether DATE-OBS is UTC: add DATE-UTC or DATE-LOC, or take "
        f"{zone} away"
    )


def _check_written(header: Mapping, mid_unix_s: float) -> None:
    """TimeError if the file was written more than a day before the exposure."""
    written = _other_unix_s(header, "DATE", mid_unix_s)
    if written is not None and mid_unix_s - written[0] > DAY_S:
        days = (mid_unix_s - written[0]) / DAY_S
        raise TimeError(
            f"its file was written (DATE) {days:.1f} days before its exposure: the clock was wrong, or day and month are "
            "exchanged: correct the header, or take DATE away"
        )


def _offset_h(value: Any) -> float | None:
    """Hours of a zone from UTC, like 2, '+02:00' or 'UTC+2'; None for anything else."""
    if isinstance(value, bool):
        return None
    if isinstance(value, (int, float)):
        return float(value) if abs(value) <= 15 else None
    found = re.fullmatch(r" *(?:UTC?|GMT)? *([+-]?) *(\d\d?)(?::?(\d\d))? *", str(value), re.IGNORECASE)
    if found is None:
        return None
    hours = int(found[2]) + int(found[3] or 0) / 60
    return -hours if found[1] == "-" else hours


def _apart_s(one: _Moment, other: _Moment) -> float:
    """How much farther two middles are apart than rounding of their digits explains."""
    step_s = math.sqrt(3) * (one.stddev_s + other.stddev_s)
    # and the last bits of sums
    return max(0.0, abs(one.tai_s - other.tai_s) - step_s - 1e-6)


def _check_single(header: Mapping) -> None:
    """Raise TimeError for a stack: it shows the sky of one of its exposures, which need not be the middle one."""
    for key in CARDS["count"]:
        count = header.get(key)
        if isinstance(count, (int, float)) and count > 1:
            raise TimeError(
                f"it is a stack of {count:g} exposures ({key}), whose light has no one time: give single exposures"
            )
    named = STACKED.search(str(header.get("IMAGETYP") or ""))
    if named or header.get("IMCMB002") not in (None, ""):
        by = "IMAGETYP" if named else "IMCMB002"
        raise TimeError(
            f"it is a stack of exposures ({by}), whose light has no one time: give single exposures"
        )


def _lengths(header: Mapping, comments: Mapping[str, str]) -> dict[str, float]:
    """The lengths of the exposure in s by card; 0 is missing. TimeError for a value that is not a length."""
    lengths = {}
    general = str(header.get("TIMEUNIT") or "s").strip().lower()
    for key in _stated(header, LENGTHS):
        value = header[key]
        named = re.search(r"\[ *(\w+) *\]", comments.get(key, ""))
        unit_s = UNITS_S.get(named[1].lower() if named else general)
        try:
            length = float(value) * (unit_s or 1.0)
        except (TypeError, ValueError, OverflowError):
            length = math.nan
        if not 0 <= length <= MAX_EXPOSURE_S:
            raise TimeError(
                f"its {key} is {one_line(repr(value))}: give 0 to {MAX_EXPOSURE_S:g} s, correct the header"
            )
        if length > 0:
            lengths[key] = length
    return lengths


def _no_length(header: Mapping) -> str:
    if zero := _stated(header, LENGTHS):
        return f"how long it was exposed is unknown, its {zero[0]} is 0: correct the header"
    return "how long it was exposed is unknown: its header needs EXPTIME"


def _moments(header: Mapping) -> dict[str, _Moment]:
    """The times in the header by card; TimeError for a value that is not a time."""
    keys = _stated(header, (*START, *MIDDLE, *END))
    scale = str(header.get("TIMESYS") or "UTC").strip().lower()
    if keys and scale not in TIME_SCALES:
        raise TimeError(f"its TIMESYS is {scale[:20]!r}: it must be one of {', '.join(TIME_SCALES)}")
    moments = {key: _moment(header, key, scale) for key in keys}
    return {key: moment for key, moment in moments.items() if moment is not None}


def _middles(moments: Mapping[str, _Moment], lengths: Mapping[str, float]) -> list[_Moment]:
    """The middles of the exposure by the cards; TimeError if they end early."""
    starts, middles, ends = (
        [moments[key] for key in keys if key in moments] for keys in (START, MIDDLE, END)
    )
    for start in starts:
        middles += [
            _Moment(start.tai_s + s / 2, start.stddev_s, f"{start.by} with {key}")
            for key, s in lengths.items()
        ]
        for end in ends:
            if end.tai_s < start.tai_s:
                raise TimeError(f"its {end.by} is before its {start.by}: correct the header")
            # an end is often the arrival of the frame: a start and a length are better
            stddev_s = math.hypot(start.stddev_s, end.stddev_s)
            middles.append(_Moment((start.tai_s + end.tai_s) / 2, stddev_s, f"{start.by} with {end.by}"))
    if not starts:
        # a clock read on arrival of the frame is late
        middles += [
            _Moment(end.tai_s - s / 2, math.hypot(end.stddev_s, UNKNOWN_LATENCY_S), f"{end.by} with {key}")
            for end in ends
            for key, s in lengths.items()
        ]
    return middles


def _span_s(moments: Mapping[str, _Moment]) -> float | None:
    """The length of the exposure from its start to its end, as far as these are known."""
    start, end = (next((moments[key] for key in keys if key in moments), None) for keys in (START, END))
    if start is None or end is None:
        return None
    span_s = end.tai_s - start.tai_s
    return span_s if 0 < span_s <= MAX_EXPOSURE_S else None


def _moment(header: Mapping, key: str, scale: str) -> _Moment | None:
    """The time of a card; None if it is a day without an hour. TimeError if it is not a time."""
    value = header[key]
    if key.startswith("MJD"):
        try:
            value = float(value)
        except (TypeError, ValueError, OverflowError):
            raise TimeError(
                f"its {key} is {one_line(repr(value))}, which is no number: give an MJD"
            ) from None
    else:
        value = _as_today(value)
        # a number of another keyword (a Julian date, Unix time) would pass for an MJD
        if not isinstance(value, str):
            raise TimeError(
                f"its {key} is {value!r}, which is no text: write it like 2026-11-02T18:00:00.000"
            )
        if DAY.fullmatch(value):
            hours = _stated(header, HOURS)
            if not hours or key in (*MIDDLE, *END):
                return None
            # a card of the hours may repeat the day
            hour = _as_today(str(header[hours[0]]))
            value = hour if hour.startswith(f"{value}T") else f"{value}T{hour}"
    try:
        return _Moment(_tai_s(value, scale), _rounding(value), key)
    except (ValueError, TypeError, OverflowError):
        raise TimeError(
            f"its {key} is {one_line(repr(value))}, which is no time of an exposure (hours to 23, minutes and seconds to "
            "59): write it like 2026-11-02T18:00:00.000"
        ) from None


def _unix_s(tai_s: float) -> float:
    """Unix time of a number of seconds in TAI since 1970."""
    days, rest_s = divmod(tai_s, DAY_S)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", erfa.ErfaWarning)
        day, part = erfa.taiutc(UNIX_EPOCH_JD + days, rest_s / DAY_S)
    return float((day - UNIX_EPOCH_JD) * DAY_S + part * DAY_S)


def _as_today(start: Any) -> Any:
    """Text as FITS wants it today, of a day of the 20th century as FITS had it before 1999, or with a space for the T."""
    if not isinstance(start, str):
        return start
    text = re.sub(r"^(\d\d)/(\d\d)/(\d\d)(?!\d)", r"19\3-\2-\1", start.strip())
    return re.sub(r"^(\d{4}-\d\d-\d\d) +(?=\d\d:)", r"\1T", text)


def _rounding(start: float | str) -> float:
    """Standard deviation (s) from the last digit of a text or an MJD, rounded or cut off; 0 for a long MJD."""
    if not isinstance(start, str):
        digits = repr(start).partition(".")[2].rstrip("0")
        sigma_s = DAY_S * 10.0 ** -len(digits) / math.sqrt(3)
        return sigma_s if sigma_s > MIN_MJD_STEP_S else 0.0
    decimals = re.search(r":\d\d:\d\d(?:\.(\d*))?", start)
    # a time without seconds
    if decimals is None:
        return 60 / math.sqrt(3)
    return 10.0 ** -len(decimals[1] or "") / math.sqrt(3)


def _tai_s(start: float | str, scale: str) -> float:
    """Seconds in TAI since 1970 of a text or an MJD in its scale; ValueError if it is no time.

    By ERFA alone: astropy's times, which are ERFA's, take as long to import as the rest of a program's start.
    """
    try:
        with warnings.catch_warnings():
            # of years whose leap seconds are not known yet
            warnings.simplefilter("ignore", erfa.ErfaWarning)
            # a second beyond the end of its minute
            warnings.filterwarnings("error", ".*(after end of day|both of)", erfa.ErfaWarning)
            if isinstance(start, str):
                found = ISO_TIME.fullmatch(start.strip())
                if found is None:
                    raise ValueError(start)
                *whole, seconds = found.groups()
                # GPS time has no leap seconds, like TAI
                day, part = erfa.dtf2d(
                    "UTC" if scale == "utc" else "TAI", *map(int, whole), float(seconds or 0)
                )
            elif abs(start) < FARTHEST_MJD:
                day, part = MJD_ZERO_JD, start
            else:
                raise ValueError(start)
            if scale == "utc":
                day, part = erfa.utctai(day, part)
            if scale == "gps":
                part += GPS_BEHIND_TAI_S / DAY_S
            if scale == "tdb":
                # at the geocentre; the time of day has no part in it there
                day, part = erfa.tdbtt(day, part, erfa.dtdb(day, part, 0.0, 0.0, 0.0, 0.0))
            if scale in ("tdb", "tt"):
                day, part = erfa.tttai(day, part)
    except (erfa.ErfaError, erfa.ErfaWarning) as e:
        raise ValueError(start) from e
    return float((day - UNIX_EPOCH_JD) * DAY_S + part * DAY_S)

# SPDX-License-Identifier: Apache-2.0
"""What a camera writes into its own files (EXIF 2.31): time, exposure, focal length, and how well they are known.

`Exif` reads the tags of any picture or raw file, one fact a property, and `read_exposure` makes an Exposure of them. A
new fact is a new property there, and a field of Exposure. Rows and columns are the sensor's in every format, however the
camera was held: what turns a picture for the eye (EXIF's Orientation, the boxes irot and imir of HEIF) is not applied.

A camera's clock is set by hand to the time of some zone, and often shows whole seconds only. So its time is used only if
a person has said how good the clock is (CameraClock).
"""

import io
import math
import re
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import datetime, timezone

from starpos.errors import FrameError, TimeError
from starpos.frames.exposure import MAX_EXPOSURE_S, UNKNOWN_LATENCY_S, Exposure
from starpos.frames.gravity import TELEPHONES, read_gravity, read_upper_edge

# Canon and Nikon allow their clocks an error of a minute a month. A telephone's is set by its network, a DJI's by GPS.
UNTENDED_STDDEV_S, NETWORK_STDDEV_S = 60.0, 1.0
NETWORKED = re.compile(f"dji|{TELEPHONES.pattern}", re.IGNORECASE)
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
    stddev_s      standard deviation of its error, which all frames share, s; None: as the maker's clocks are set
    """

    utc_offset_h: float | None = None
    stddev_s: float | None = None

    def __post_init__(self) -> None:
        if self.utc_offset_h is not None and not abs(self.utc_offset_h) <= ZONES_H:
            raise TimeError(
                f"a camera's clock {self.utc_offset_h:g} h from UTC is of no zone: give -{ZONES_H:g} to {ZONES_H:g} h"
            )
        if self.stddev_s is not None and not 0 <= self.stddev_s <= 86400:
            raise TimeError(f"a camera's clock is known to {self.stddev_s:g} s: give 0 to 86400 s")


# a date and time in the name of a file, as all-sky cameras have them: image-20260930224951.jpg, 2019-07-29T204726.tiff;
# it may be of the start or the end of an exposure of up to a minute
NAMED_TIME = re.compile(
    r"(?<!\d)(20\d\d)-?([01]\d)-?([0-3]\d)[T_ -]?([0-2]\d)[:-]?([0-5]\d)[:-]?([0-5]\d)(?!\d)[^/]*$", re.ASCII
)
NAMED_STDDEV_S = 20.0


@dataclass(frozen=True, eq=False)
class Exif:
    """What the EXIF of a picture of width x height px states; None for what it does not, or what is impossible.

    tags  by the names that exifread gives them
    """

    tags: Mapping
    width: int
    height: int

    @classmethod
    def of(cls, data: bytes, width: int, height: int) -> "Exif":
        """Read the EXIF of a TIFF, JPEG, PNG or TIFF-like raw file (DNG, CR2, NEF ...); ImportError without exifread."""
        import logging

        import exifread

        # it warns about every file without EXIF
        logging.getLogger("exifread").setLevel(logging.CRITICAL)
        try:
            return cls(exifread.process_file(io.BytesIO(data), details=False), width, height)
        # damaged bytes make it raise any kind of exception
        except Exception:
            return cls({}, width, height)

    def number(self, name: str, group: str = "EXIF") -> float | None:
        """The positive number that is a tag's first value."""
        try:
            value = self.tags[f"{group} {name}"].values[0]
            number = value.num / value.den if hasattr(value, "den") else float(value)
        except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError):
            return None
        return number if 0 < number < math.inf else None

    def text(self, name: str) -> str:
        """The text of a tag without padding, by its name in exifread; empty if the tag is missing."""
        value = getattr(self.tags.get(name), "values", "")
        return value.replace("\0", " ").strip() if isinstance(value, str) else ""

    def sexagesimal(self, name: str) -> float:
        """A GPS tag of degrees or hours, minutes and seconds as one number; NaN without one."""
        try:
            whole, minutes, seconds = (value.num / value.den for value in self.tags[f"GPS GPS{name}"].values)
        except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError):
            return math.nan
        return whole + minutes / 60 + seconds / 3600

    @property
    def made_px(self) -> tuple[float, float]:
        """Sides (px) of the picture as the camera made it, the shorter one first; 0: not stated."""
        shorter, longer = sorted(self.number(name) or 0.0 for name in ("ExifImageWidth", "ExifImageLength"))
        return shorter, longer

    @property
    def is_cropped(self) -> bool:
        """Whether the picture has another shape than the one that the camera made, in either orientation."""
        shorter, longer = self.made_px
        shape = max(self.width, self.height) / min(self.width, self.height)
        return shorter > 0 and abs(shorter / longer * shape - 1) > SAME_SHAPE

    @property
    def exposure_s(self) -> float | None:
        """ExposureTime in s; some programs write it among the tags of the image."""
        seconds = self.number("ExposureTime") or self.number("ExposureTime", "Image")
        return seconds if seconds is not None and seconds <= MAX_EXPOSURE_S else None

    @property
    def rough_focal_px(self) -> float | None:
        """About the focal length in px: FocalLengthIn35mmFilm, else FocalLength and FocalPlaneXResolution."""
        film_mm, focal_mm = self.number("FocalLengthIn35mmFilm"), self.number("FocalLength")
        per_unit, unit = (self.number(f"FocalPlane{name}") for name in ("XResolution", "ResolutionUnit"))
        diagonal_px, focal_px = math.hypot(self.width, self.height), None
        if film_mm is not None:
            focal_px = film_mm / FILM_MM * diagonal_px
        elif focal_mm is not None and per_unit is not None:
            # the resolution is of the picture as the camera made it, which may have been reduced since
            longer_px = max(self.width, self.height)
            scale = longer_px / (self.made_px[1] or longer_px)
            focal_px = focal_mm * per_unit / UNITS_MM.get(int(unit or 2), UNITS_MM[2]) * scale
        if focal_px is None or not SHORTEST * diagonal_px < focal_px < LONGEST * diagonal_px:
            return None
        return focal_px

    @property
    def is_fisheye(self) -> bool:
        """Whether lens or camera is called a fisheye."""
        return any(FISHEYE.search(self.text(name)) for name in NAMES)

    @property
    def gps_deg(self) -> tuple[float, float] | None:
        """GPSLatitude and GPSLongitude, deg on WGS 84, north and east positive."""
        latitude, longitude = self.sexagesimal("Latitude"), self.sexagesimal("Longitude")
        if not (0 <= latitude <= 90 and 0 <= longitude <= 180):
            return None
        south, west = (self.text(f"GPS GPS{name}Ref").upper() for name in ("Latitude", "Longitude"))
        return latitude * (-1 if south == "S" else 1), longitude * (-1 if west == "W" else 1)

    @property
    def clock_stddev_s(self) -> float:
        """Standard deviation of a clock as this maker's are set, s."""
        networked = NETWORKED.match(self.text("Image Make"))
        return NETWORK_STDDEV_S if networked else UNTENDED_STDDEV_S

    @property
    def is_stamped_late(self) -> bool:
        """Whether a program wrote it that stamps the end of the exposure, in local time, as GPS's time too."""
        return self.text("Image Software") == "indi-allsky"

    @property
    def gps_unix_s(self) -> float | None:
        """GPSDateStamp and GPSTimeStamp, UTC of the last fix, as a Unix time."""
        if self.is_stamped_late:
            return None
        hours = self.sexagesimal("TimeStamp")
        try:
            day = datetime.strptime(self.text("GPS GPSDate"), "%Y:%m:%d")
        except ValueError:
            return None
        return day.replace(tzinfo=timezone.utc).timestamp() + 3600 * hours if 0 <= hours <= 24 else None

    def ahead_of_utc_s(self, clock: CameraClock) -> float | None:
        """Time in s by which the camera's clock was ahead of UTC, by the user or by OffsetTimeOriginal."""
        if clock.utc_offset_h is not None:
            return 3600 * clock.utc_offset_h
        parts = re.fullmatch(r"([+-])(\d\d):(\d\d)", self.text("EXIF OffsetTimeOriginal"))
        return float(parts[1] + "1") * (3600 * int(parts[2]) + 60 * int(parts[3])) if parts else None

    def start(self, clock: CameraClock) -> tuple[float, float]:
        """Unix time of the exposure's start (middle of the clock's last step before it), and the length of a step (s).

        The zone is the clock's, else OffsetTimeOriginal's, else by GPS's time; TimeError if there is no time, no zone,
        or if GPS contradicts it.
        """
        text = self.text("EXIF DateTimeOriginal")
        try:
            shown = datetime.strptime(text, "%Y:%m:%d %H:%M:%S")
        except ValueError:
            shown = datetime.min
        if shown.year < FIRST_YEAR:
            raise TimeError(f"its EXIF was taken at {text!r}, which is no time: set the camera's clock")
        shown_s, gps_s = shown.replace(tzinfo=timezone.utc).timestamp(), self.gps_unix_s
        ahead_s = None if gps_s is None else shown_s - gps_s
        offset_s, zone = self.ahead_of_utc_s(clock), self.text("EXIF OffsetTimeOriginal")
        if offset_s is None and ahead_s is not None and abs(ahead_s) <= 3600 * ZONES_H + GPS_APART_S:
            offset_s = round(ahead_s / ZONE_STEP_S) * ZONE_STEP_S
        if offset_s is None:
            raise TimeError(
                f"its EXIF has no zone (OffsetTimeOriginal is {zone!r}) and no time by GPS: say "
                "by how many hours the camera's clock is before UTC (--exif-utc-offset)"
            )
        if ahead_s is not None and abs(ahead_s - offset_s) > GPS_APART_S:
            raise TimeError(
                f"by the GPS time in its EXIF the camera's clock was {ahead_s / 3600:.2f} h ahead of UTC, and not "
                f"{offset_s / 3600:g} h: state the zone that it showed, or set it"
            )
        digits = self.text("EXIF SubSecTimeOriginal")
        # many cameras that count no fractions write zeros
        if not re.fullmatch(r"\d{1,9}", digits) or not int(digits):
            digits = ""
        step_s = 10.0 ** -len(digits)
        return shown_s - offset_s + (int(digits or 0) + 0.5) * step_s, step_s


def read_exposure(data: bytes, place: str, clock: CameraClock | None, shape: tuple[int, ...]) -> Exposure:
    """Read the Exposure that the EXIF of a picture or raw file states; shape: of the pixels, rows first.

    origin_px is NaN if the picture is a crop. Only with a clock there is a time, or `untimed`: DateTimeOriginal and
    SubSecTimeOriginal are the start of the exposure, rounded down; when the shutter opened is known less well. Without
    them the name of the file may have a time. FrameError if exifread is missing where a clock asks for it.
    """
    try:
        exif = Exif.of(data, shape[1], shape[0])
    except ImportError:
        if clock is None:
            return Exposure(source=place)
        raise FrameError(f"{place}: reading EXIF needs exifread; run `pip install exifread`.") from None
    try:
        gravity, unlevelled = read_gravity(data, exif.width, exif.height), ""
    except FrameError as e:
        gravity, unlevelled = None, str(e)
    exposure = Exposure(
        source=place,
        gravity=gravity,
        unlevelled=unlevelled,
        upper_edge=read_upper_edge(data, exif.width, exif.height),
        gps_deg=exif.gps_deg,
        exposure_s=exif.exposure_s,
        rough_focal_px=exif.rough_focal_px,
        fisheye=exif.is_fisheye,
        origin_px=(math.nan, math.nan) if exif.is_cropped else None,
    )
    if clock is None:
        return exposure
    offset_h, named = clock.utc_offset_h, NAMED_TIME.search(place)
    if offset_h is not None and "EXIF DateTimeOriginal" not in exif.tags and named is not None:
        with suppress(ValueError):
            shown = datetime.strptime(" ".join(named.groups()), "%Y %m %d %H %M %S").replace(
                tzinfo=timezone.utc
            )
            return replace(
                exposure,
                mid_unix_s=shown.timestamp() - 3600 * offset_h + (exposure.exposure_s or 0.0) / 2,
                stamp_stddev_s=NAMED_STDDEV_S,
                clock_stddev_s=UNTENDED_STDDEV_S if clock.stddev_s is None else clock.stddev_s,
            )
    if exposure.exposure_s is None or "EXIF DateTimeOriginal" not in exif.tags:
        missing = "ExposureTime" if exposure.exposure_s is None else "DateTimeOriginal"
        return replace(exposure, untimed=f"its EXIF has no {missing}: give the file as the camera wrote it")
    try:
        start_unix_s, step_s = exif.start(clock)
    except TimeError as e:
        return replace(exposure, untimed=str(e))
    late_s = exposure.exposure_s if exif.is_stamped_late else 0.0
    return replace(
        exposure,
        mid_unix_s=start_unix_s + exposure.exposure_s / 2 - late_s,
        stamp_stddev_s=math.hypot(step_s / math.sqrt(12), UNKNOWN_LATENCY_S),
        clock_stddev_s=exif.clock_stddev_s if clock.stddev_s is None else clock.stddev_s,
    )

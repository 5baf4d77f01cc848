# SPDX-License-Identifier: Apache-2.0
"""Facts of an exposure besides its pixels: time, length, times of its rows, stamp of its driver."""

import math
from dataclasses import dataclass, fields, replace
from typing import Any, TypeVar

import numpy as np

from starpos.errors import FrameError
from starpos.frames.gravity import Gravity

# 1 sigma of an unstated readout: evenly up to 50 ms, from the top or from the bottom
UNKNOWN_READOUT_S = 0.03
MAX_READOUT_S = 10.0
# 1 sigma of the time from a consumer camera's stamp to the opening of its shutter: evenly up to 100 ms
UNKNOWN_LATENCY_S = 0.06


@dataclass(frozen=True)
class Shutter:
    """Times of a frame's rows; FrameError for impossible values.

    readout_s         from the row that is read first to the last, s: positive where the top row is first, negative
                      where it is the bottom row; 0 where all rows are exposed at once (a global shutter), or where it is
                      unknown which is first
    readout_stddev_s  its standard deviation
    """

    readout_s: float = 0.0
    readout_stddev_s: float = UNKNOWN_READOUT_S

    def __post_init__(self) -> None:
        if not (abs(self.readout_s) <= MAX_READOUT_S and 0 <= self.readout_stddev_s <= MAX_READOUT_S):
            raise FrameError(
                f"a shutter's readout of {self.readout_s:g} s +- {self.readout_stddev_s:g} s is impossible: "
                f"give at most "
                f"{MAX_READOUT_S:g} s from the first row to the last, negative where the bottom row is first, and its "
                "standard deviation"
            )

    def later_s(self, y: np.ndarray, height: int) -> np.ndarray:
        """Time (N,) in s from the stamp to the middle of the exposure of the rows y (N,) px of a frame of that height."""
        return abs(self.readout_s) * self._share(y, height)

    def errors_s(self, y: np.ndarray, height: int) -> np.ndarray:
        """Change (N, 2) of `later_s` for two independent errors of 1 sigma, which all frames share."""
        # from an unknown end: the difference from row to row has either sign, and their mean is late by half the readout
        middle = 0.0 if self.readout_s else 0.5
        errors = np.empty((len(y), 2))
        errors[:, 0], errors[:, 1] = self._share(y, height) - middle, middle
        return self.readout_stddev_s * errors

    def _share(self, y: np.ndarray, height: int) -> np.ndarray:
        """Share (N,) of the readout that is over when the rows y (N,) are read."""
        down = np.asarray(y, float) / max(height - 1, 1)
        return 1 - down if self.readout_s < 0 else down


GLOBAL_SHUTTER = Shutter(0.0, 0.0)
UNKNOWN_SHUTTER = Shutter()


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
    gravity         which way is up in it by its own file, as a telephone's photograph has it; None: not stated
    unlevelled      why gravity is None, for messages
    upper_edge      direction in C of the edge that was up, (0, 0) if unknown, of a telephone's picture; None: of others
    site_cards      the cards of its header that state a site, for messages; '': none
    site_deg        that site's latitude and longitude, of either sign; compared with a fix, never used; None: not stated
    aim_deg         right ascension and declination to which its header says that it was pointed; only a hint; None: not
                    stated
    gps_deg         latitude and longitude by GPS in its file, WGS 84; compared with a fix, never used; None: not stated

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
    gravity: Gravity | None = None
    unlevelled: str = ""
    upper_edge: tuple[int, int] | None = None
    gps_deg: tuple[float, float] | None = None
    site_cards: str = ""
    site_deg: tuple[float, float] | None = None
    aim_deg: tuple[float, float] | None = None

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
    def facts(self) -> dict[str, Any]:
        """The fields above by name, to make another object of the same exposure."""
        return {f.name: getattr(self, f.name) for f in fields(Exposure)}


def check_size(width: int, height: int, place: str) -> None:
    """Raise FrameError unless width and height are whole numbers of 1 to LARGEST_SIDE_PX pixels."""
    for name, value in (("width", width), ("height", height)):
        if not isinstance(value, (int, np.integer)) or not 1 <= value <= LARGEST_SIDE_PX:
            raise FrameError(
                f"{place}: the frame's {name} is {value!r}; it must be a whole number, 1 to {LARGEST_SIDE_PX} px."
            )


Stamped = TypeVar("Stamped", bound=Exposure)

# What a driver may stamp: `sensor_msgs/Image` has no field that says which.
MIDDLE, START, END, ARRIVAL, UNKNOWN_STAMP = "middle", "start", "end", "arrival", ""
STAMPS = (UNKNOWN_STAMP, MIDDLE, START, END, ARRIVAL)
# 1 sigma if the stamped moment is not stated, and of an image's way to the host
UNKNOWN_STDDEV_S = 0.3
# 1 sigma where the moment is known: from it until the driver reads its clock
KNOWN_STDDEV_S = 0.02
# m of longitude per s at the equator, for sentences
METRES_PER_S = 464


@dataclass(frozen=True)
class DriverStamp:
    """The meaning of a driver's stamps; all moments are of the row that is read first.

    kind        MIDDLE, START or END of the exposure, ARRIVAL of the image after its last row was read; UNKNOWN_STAMP
    stddev_s    of the stamp; NaN: what the kind allows
    exposure_s  None: unknown
    readout_s   as in Shutter; NaN: unknown
    """

    kind: str = UNKNOWN_STAMP
    stddev_s: float = math.nan
    exposure_s: float | None = None
    readout_s: float = math.nan

    def __post_init__(self) -> None:
        if self.kind not in STAMPS:
            raise FrameError(f"a stamp is of the {self.kind!r}: give {', '.join(STAMPS[1:])}, or nothing")
        if self.exposure_s is not None and not 0 < self.exposure_s <= MAX_EXPOSURE_S:
            raise FrameError(
                f"an exposure of {self.exposure_s} s is impossible: give up to {MAX_EXPOSURE_S:g} s"
            )

    @property
    def to_middle_s(self) -> float:
        """From the stamp to the middle of the exposure."""
        half = (self.exposure_s or 0.0) / 2
        readout = 0.0 if math.isnan(self.readout_s) else abs(self.readout_s)
        return {START: half, END: -half, ARRIVAL: -half - readout}.get(self.kind, 0.0)

    @property
    def middle_stddev_s(self) -> float:
        """Standard deviation of the middle of the exposure that follows from the stamp."""
        known = self.kind in (MIDDLE, START, END)
        usual = KNOWN_STDDEV_S if known else UNKNOWN_STDDEV_S
        stddev_s = usual if math.isnan(self.stddev_s) else self.stddev_s
        if self.kind in (START, END, ARRIVAL) and self.exposure_s is None:
            return max(stddev_s, UNKNOWN_STDDEV_S)
        if self.kind == UNKNOWN_STAMP and math.isnan(self.stddev_s):
            # it may be either end
            return max(stddev_s, (self.exposure_s or 0.0) / 2)
        return stddev_s

    @property
    def missing_statement(self) -> str:
        """Sentence on what has to be stated for a smaller error; '' if nothing."""
        if self.kind == UNKNOWN_STAMP and math.isnan(self.stddev_s):
            gap = (
                f"nothing says which moment the frames' stamps are ({', '.join(STAMPS[1:])}): set the parameters stamp, "
                "stamp_stddev and exposure"
            )
        elif self.kind in (START, END, ARRIVAL) and self.exposure_s is None:
            gap = (
                f"the stamps are of the {self.kind}, and nothing says how far the middle of the exposure is from it: "
                "set the parameter exposure"
            )
        elif self.kind == ARRIVAL and math.isnan(self.stddev_s):
            gap = "the stamps are of the arrival, and nothing says how late that is: set the parameter stamp_stddev"
        else:
            return ""
        stddev_s = self.middle_stddev_s
        metres = stddev_s * METRES_PER_S
        return f"{gap}. Until then the time is taken as {stddev_s:.2g} s off, {metres:.0f} m at the equator (1 sigma)."

    def apply(self, stamped: Stamped) -> Stamped:
        """The exposure, whose mid_unix_s is the stamp, with its middle and the other facts."""
        mid_s = None if stamped.mid_unix_s is None else stamped.mid_unix_s + self.to_middle_s
        return replace(
            stamped,
            mid_unix_s=mid_s,
            exposure_s=self.exposure_s,
            stamp_stddev_s=self.middle_stddev_s,
            shutter=None if math.isnan(self.readout_s) else Shutter(self.readout_s, 0.0),
        )

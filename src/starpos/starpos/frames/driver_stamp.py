# SPDX-License-Identifier: Apache-2.0
"""What the time stamp of a camera driver means; the images themselves do not say.

Drivers stamp the start of an exposure, its middle or its end, or the arrival of the image, and `sensor_msgs/Image` has
no field that says which.
"""

import math
from dataclasses import dataclass, replace

from starpos.errors import FrameError
from starpos.frames.exposure import MAX_EXPOSURE_S, Shutter
from starpos.frames.frame import Frame

MIDDLE, START, END, ARRIVAL, UNKNOWN = "middle", "start", "end", "arrival", ""
KINDS = (UNKNOWN, MIDDLE, START, END, ARRIVAL)
# 1 sigma if the stamped moment is not stated, and of an image's way to the host
UNKNOWN_STDDEV_S = 0.3
# 1 sigma where the moment is known: from it until the driver reads its clock
KNOWN_STDDEV_S = 0.02
# m of longitude per s at the equator, for sentences
METRES_PER_S = 464


@dataclass(frozen=True)
class DriverStamp:
    """The meaning of a driver's stamps; all moments are of the row that is read first.

    kind        MIDDLE, START or END of the exposure, ARRIVAL of the image after its last row was read; UNKNOWN
    stddev_s    of the stamp; NaN: what the kind allows
    exposure_s  None: unknown
    readout_s   as in Shutter; NaN: unknown
    """

    kind: str = UNKNOWN
    stddev_s: float = math.nan
    exposure_s: float | None = None
    readout_s: float = math.nan

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise FrameError(f"a stamp is of the {self.kind!r}: give {', '.join(KINDS[1:])}, or nothing")
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
        if self.kind == UNKNOWN and math.isnan(self.stddev_s):
            # it may be either end
            return max(stddev_s, (self.exposure_s or 0.0) / 2)
        return stddev_s

    @property
    def unsaid(self) -> str:
        """Sentence on what has to be stated for a smaller error; '' if nothing."""
        if self.kind == UNKNOWN and math.isnan(self.stddev_s):
            lacks = (
                f"nothing says which moment the frames' stamps are ({', '.join(KINDS[1:])}): set the parameters stamp, "
                "stamp_stddev and exposure"
            )
        elif self.kind in (START, END, ARRIVAL) and self.exposure_s is None:
            lacks = (
                f"the stamps are of the {self.kind}, and nothing says how far the middle of the exposure is from it: "
                "set the parameter exposure"
            )
        elif self.kind == ARRIVAL and math.isnan(self.stddev_s):
            lacks = "the stamps are of the arrival, and nothing says how late that is: set the parameter stamp_stddev"
        else:
            return ""
        stddev_s = self.middle_stddev_s
        metres = stddev_s * METRES_PER_S
        return f"{lacks}. Until then the time is taken as {stddev_s:.2g} s off, {metres:.0f} m at the equator (1 sigma)."

    def dated(self, frame: Frame) -> Frame:
        """The frame, whose mid_unix_s is the stamp, with the middle and the facts of its exposure."""
        mid_s = None if frame.mid_unix_s is None else frame.mid_unix_s + self.to_middle_s
        return replace(
            frame,
            mid_unix_s=mid_s,
            exposure_s=self.exposure_s,
            stamp_stddev_s=self.middle_stddev_s,
            shutter=None if math.isnan(self.readout_s) else Shutter(self.readout_s, 0.0),
        )

# SPDX-License-Identifier: Apache-2.0
"""Where the optical axis pierces the frames of a night, as far as their part of the sensor is known."""

import math
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from starpos.instrument.instrument import Instrument
from starpos.units import ARCSEC

# Longer over shorter side of sensors and of cameras' crops, and tolerance on it.
SHAPES = (1.0, 5 / 4, 4 / 3, 3 / 2, 8 / 5, 16 / 9)
SHAPE_OFF = 0.05
# Frame sizes of some cameras; programs also crop larger sensors to these sizes.
STANDARD_SIZES = {(320, 240), (640, 480), (800, 600), (1024, 768), (1280, 720), (1280, 960), (1280, 1024), (1600, 1200),
                  (1920, 1080)}  # fmt: skip
# 1 sigma of the axis from a frame's centre if the frame's part of the sensor is unknown: its longer side, and at least
# this, as most sensors have up to 7000 px
MIN_UNKNOWN_PX = 2000.0
SIZE_IN_FILE = "camera: {focal_mm, pixel_um, width, height} in the instrument file"


class Framed(Protocol):
    """A frame's geometry, in px."""

    @property
    def width(self) -> int:
        """Its width."""

    @property
    def height(self) -> int:
        """Its height."""

    @property
    def origin_px(self) -> tuple[float, float] | None:
        """Column and row of the sensor's whole frame at which it begins, as an Exposure has it."""


@dataclass(frozen=True)
class AxisDoubt:
    """Why the optical axis's place in frames is unknown; its 1 sigma in px and rad, 0 if it does not count."""

    why: str
    error_px: float = 0.0
    error_rad: float = 0.0

    def counted_as(self, error: str) -> str:
        """The doubt as a sentence; error: the error that it becomes a part of."""
        if not self.error_px:
            return (
                f"{self.why}: if they are cut out of larger ones, the optical axis may be off their middle and the place "
                f"wrong: give the whole frame's size, {SIZE_IN_FILE}"
            )
        return (
            f"{self.why}: the optical axis may be {self.error_px:.0f} px from their centre, "
            f"{math.degrees(self.error_rad):.2g} deg that count as an error of {error}: give the whole frame's size, "
            f"{SIZE_IN_FILE}"
        )


def framed(instrument: Instrument, first: Framed) -> tuple[Instrument, AxisDoubt | None]:
    """The instrument for the frames of a night by the first of them; and a doubt if their axis is not known.

    An instrument that knows its frame's size stays as it is.  Else a frame counts as a whole one, and its size holds for
    the others, unless its header says that it begins somewhere on a sensor, or no sensor has its shape.  A standard size
    may be either: that is a doubt, which is not counted.
    """
    if instrument.size is not None:
        return instrument, None
    width, height, origin_px = first.width, first.height, first.origin_px
    longer, shorter = max(width, height), min(width, height)
    if origin_px is None:
        instrument = replace(instrument, frame_size=(width, height))
        if any(abs(longer / shorter / shape - 1) < SHAPE_OFF for shape in SHAPES):
            doubtful = (longer, shorter) in STANDARD_SIZES
            whole = AxisDoubt(f"frames of {width} x {height} px count as whole ones")
            return instrument, whole if doubtful else None
        why = f"no sensor has the shape of frames of {width} x {height} px"
    elif np.isfinite(origin_px).all():
        left, top = origin_px
        # a crop is assumed to be from the middle, for lack of better; frames that begin elsewhere then agree with it
        whole_size = round(width + 2 * max(left, 0.0)), round(height + 2 * max(top, 0.0))
        instrument = replace(instrument, frame_size=whole_size)
        why = (
            f"these frames of {width} x {height} px begin at column {left:g}, row {top:g} of a sensor whose "
            f"size is not stated"
        )
    else:
        why = f"these frames of {width} x {height} px are cut out of larger ones at an unstated position"
    error_px = max(longer, MIN_UNKNOWN_PX)
    return instrument, AxisDoubt(why, error_px, math.atan(error_px / instrument.focal_px))


def with_frame_size(instrument: Instrument, first: Framed) -> tuple[Instrument, str]:
    """The instrument as `framed` has it, with the axis's error included in A3's, and its doubt; '' if A3 is not known.

    The error stands in axis_stddev_rad too, for headings at a known place, which need no A3.
    """
    instrument, doubt = framed(instrument, first)
    if doubt is not None:
        instrument = replace(instrument, axis_stddev_rad=doubt.error_rad)
    calibration = instrument.calibration
    if doubt is None or calibration.unknown:
        return instrument, ""
    widened = np.asarray(calibration.covariance_arcsec2, float) + np.eye(3) * (doubt.error_rad / ARCSEC) ** 2
    wide = replace(calibration, covariance_arcsec2=tuple(map(tuple, widened.tolist())))
    return replace(instrument, calibration=wide), doubt.counted_as("A3")

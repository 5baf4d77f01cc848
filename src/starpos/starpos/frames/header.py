# SPDX-License-Identifier: Apache-2.0
"""What a frame's header says of its exposure: time, focal length, shutter, and the place of a crop on the sensor.

A header is a mapping of FITS keywords (KEYS) to values of any kind; every value is checked.
"""

import math
from collections.abc import Mapping
from contextlib import suppress
from typing import Any

from starpos.errors import FrameError
from starpos.frames import times
from starpos.frames.exposure import Shutter
from starpos.units import ARCSEC

# Cards with the column and row of the sensor's frame at which a frame begins, in pixels of this frame, and their sign:
# positive by SBFITSEXT (MaxIm, APT, Seestar and others), negative in IRAF's physical coordinates
CROPS = ((("XORGSUBF", "YORGSUBF"), 1.0), (("LTV1", "LTV2"), -1.0))
# IRAF's size of a pixel in physical ones
LTM = ("LTM1_1", "LTM2_2")
# arcsec per px, by INDI, Sequence Generator Pro and others
SCALES = ("SCALE", "PIXSCALE", "SECPIX1")
# minimum of a focal length, a pixel or a scale that counts as stated
LEAST = 1e-9
KEYS = (
    *times.KEYS,
    *(key for keys, _ in CROPS for key in keys),
    *LTM,
    *SCALES,
    "BAYERPAT",
    "XBAYROFF",
    "YBAYROFF",
    "FOCALLEN",
    "XPIXSZ",
    "ROLLSHUT",
)


def about(header: Mapping, place: str, comments: Mapping[str, str] = times.NO_COMMENTS) -> dict[str, Any]:
    """Read the fields of an Exposure that a header states; FrameError for a bad shutter. place names it in messages.

    comments: of cards, by their keywords.
    """
    return times.times(header, comments) | {
        "source": place,
        "focal_px": focal_px(header),
        "pixel_um": _positive(header, "XPIXSZ"),
        "shutter": shutter(header, place),
        "origin_px": origin_px(header),
    }


def origin_px(header: Mapping) -> tuple[float, float] | None:
    """Column and row of the sensor's frame at which a frame begins; None if nothing says so, NaN for no numbers."""
    for keys, sign in CROPS:
        if any(header.get(key) not in (None, "") for key in keys):
            with suppress(TypeError, ValueError, OverflowError):
                left, top = (sign * float(header.get(key) or 0) for key in keys)
                scales = [float(header.get(key) or 1) for key in LTM if sign < 0]
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
    scales = (_positive(header, key) for key in SCALES)
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

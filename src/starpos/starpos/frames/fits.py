# SPDX-License-Identifier: Apache-2.0
"""Read frames from FITS files, or from the bytes of one that a camera's driver has sent."""

import io
import warnings
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from starpos.errors import FrameError, one_line
from starpos.frames.frame import MAX_PIXELS, PATTERNS, Frame, to_unsigned
from starpos.frames.header import KEYS, focal_px, times

FITS_TROUBLE = (OSError, ValueError, TypeError, LookupError, AttributeError, ArithmeticError, MemoryError)


def read_fits(path: Path | str) -> Frame:
    """Read a FITS file (also .fz and .gz) by the rules of `reading.read_frame`; FrameError if it holds no frame."""
    # opened here, because astropy leaves a damaged file open
    with open(path, "rb") as file:
        return _read(file, str(path))[0]


def decode_fits(data: bytes, source: str) -> tuple[Frame, dict[str, Any]]:
    """Read the bytes of a FITS file (also .fz): the Frame, and its header's keywords of starpos.frames.header.KEYS.

    source says where the bytes came from. FrameError if they are not a whole frame.
    """
    return _read(io.BytesIO(data), source)


def _read(file: BinaryIO, place: str) -> tuple[Frame, dict[str, Any]]:
    from astropy.io import fits

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with fits.open(file, memmap=False, lazy_load_hdus=True) as hdus:
                header, values = _first_image(hdus, place)
    except (*FITS_TROUBLE, fits.VerifyError) as e:
        raise FrameError(
            f"{place}: this is not a whole FITS image ({one_line(e)}); take or copy it again."
        ) from e
    mid, exposure, rounding = times(header, place)
    frame = Frame(
        to_unsigned(values, place),
        pattern=_pattern(header, place),
        mid_unix_s=mid,
        exposure_s=exposure,
        source=place,
        focal_px=focal_px(header),
        stamp_stddev_s=rounding,
    )
    return frame, header


def _first_image(hdus: Iterable, place: str) -> tuple[dict[str, Any], np.ndarray]:
    """Header (a dict of KEYS) and data (h, w) of the first HDU that holds an image."""
    for hdu in hdus:
        shape = [int(n) for n in hdu.shape] if hdu.is_image else []
        if not shape:
            continue
        if len(shape) != 2 and not (len(shape) > 2 and max(shape[:-2]) == 1):
            size = " x ".join(map(str, reversed(shape)))
            raise FrameError(
                f"{place}: the image has {len(shape)} axes ({size}); give one monochrome plane a file."
            )
        if min(shape) < 1 or shape[-1] * shape[-2] > MAX_PIXELS:
            raise FrameError(
                f"{place}: its header claims {shape[-1]} x {shape[-2]} pixels; a frame has 1 to {MAX_PIXELS}."
            )
        header = {key: hdu.header[key] for key in KEYS if key in hdu.header}
        return header, np.asarray(hdu.data).reshape(shape[-2:])
    raise FrameError(f"{place}: there is no image in this FITS file; give one that holds a frame.")


def _pattern(header: Mapping, place: str) -> str:
    """The colour mosaic, in reading order from the first pixel."""
    pattern = str(header.get("BAYERPAT", "")).strip().lower()
    if pattern not in PATTERNS:
        raise FrameError(f"{place}: BAYERPAT is {pattern!r}; it must be RGGB, BGGR, GRBG or GBRG.")
    try:
        right, down = (int(header.get(key, 0)) % 2 for key in ("XBAYROFF", "YBAYROFF"))
    except (TypeError, ValueError, OverflowError):
        raise FrameError(f"{place}: XBAYROFF or YBAYROFF is no whole number; correct the header.") from None
    if right and pattern:
        pattern = pattern[1::-1] + pattern[:1:-1]
    return pattern[2:] + pattern[:2] if down else pattern

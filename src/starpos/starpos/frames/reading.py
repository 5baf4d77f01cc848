# SPDX-License-Identifier: Apache-2.0
"""Read frames from files: FITS, TIFF, PNG, JPEG, BMP, camera raw; and stars from a CSV of centroids."""

from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO

from starpos.errors import FrameError, one_line
from starpos.files import bytes_of
from starpos.frames.exif import CameraClock
from starpos.frames.files import MAX_BYTES, opened
from starpos.frames.fits import read_fits
from starpos.frames.frame import Frame
from starpos.frames.pictures import JPEG_START, PNG_START, picture_frame
from starpos.frames.raw import raw_frame
from starpos.frames.star_list import read_star_list
from starpos.frames.stars import Stars

FITS = (".fits", ".fit", ".fts", ".fz", ".gz")
PICTURE = (".png", ".tif", ".tiff", ".bmp")
JPEG = (".jpg", ".jpeg")  # beside raw files usually a copy of them
RAW = (".cr2", ".cr3", ".nef", ".arw", ".dng", ".raf", ".orf", ".rw2", ".pef")


def read_frame(path: Path | str, clock: CameraClock | None = None) -> Frame | Stars:
    """Read one exposure, or the star list of one; the file's suffix says which.

    clock is that of the camera which wrote the file, if it may be trusted.

    FITS (also .fz and .gz): DATE-OBS (or DATE-BEG, MJD-OBS, MJD-BEG) is the start of the exposure in UTC (or in
    TIMESYS), whose last digit is its error, EXPTIME or EXPOSURE its length in s; BAYERPAT (XBAYROFF, YBAYROFF) is the
    mosaic; FOCALLEN (mm) and XPIXSZ (um) give focal_px. The first row of the file is row 0. Values that fit 16 bits
    are only rounded. Others are shifted to begin at 0, and scaled to fill 16 bits if their range is wider than that
    or, for floats, narrower than 4096. A few NaN or infinite pixels become the median. Values farther from it than any
    light (frame.LOUDEST) are clipped.
    TIFF, PNG, JPEG, BMP: 8 or 16 bits, grey or colour. 16-bit colour is scaled down to bgr8.
    Camera raw: the mosaic as the sensor gave it, through rawpy.
    The exposure of pictures and raw files comes from EXIF if exifread is installed; their time too, but only with a
    clock.
    CSV: a first line `# {"NAXIS1": ..., "NAXIS2": ..., "DATE-OBS": ..., "EXPTIME": ...}`, in which the NAXIS pair is
    required, then columns x, y, flux and optionally sigma (px); without it sigma is 0.1 px. The SNR is 1 px / sigma, that
    of a star image whose standard deviation is 1 px.

    Without a time or an exposure mid_unix_s is None. FrameError for everything that is not as described here.
    """
    path = Path(path)
    try:
        with opened(path) as file:
            return _reader_of(path)(file, clock)
    except OSError as e:
        reason = e.strerror or one_line(e)
        raise FrameError(f"{path}: it cannot be read ({reason}); check its permissions and the disk.") from e


def _reader_of(path: Path) -> Callable[[BinaryIO, CameraClock | None], Frame | Stars]:
    """The function of the open file and the clock that reads files with this suffix."""
    suffix = path.suffix.lower()
    for suffixes, reader in (
        (FITS, lambda file, _: read_fits(file, str(path))),
        (PICTURE + JPEG, lambda file, clock: picture_frame(bytes_of(file, MAX_BYTES), str(path), clock)),
        (RAW, lambda file, clock: raw_frame(bytes_of(file, MAX_BYTES), str(path), clock)),
        ((".csv",), lambda file, _: read_star_list(file, str(path))),
    ):
        if suffix in suffixes:
            return reader
    known = " ".join(FITS + PICTURE + JPEG + RAW + (".csv",))
    raise FrameError(f"{path}: the suffix {suffix!r} is not one of a frame; use one of {known}.")


def decode_frame(data: bytes, source: str) -> Frame:
    """Read the bytes a camera sent: JPEG, PNG, TIFF or raw; FrameError if they are not a frame. Its time stays unknown.

    source is the camera's name of the file; its suffix distinguishes a TIFF from a raw file.
    """
    if data.startswith((JPEG_START, PNG_START)) or Path(source).suffix.lower() in PICTURE:
        return picture_frame(data, source)
    return raw_frame(data, source)


def why_no_time(source: str) -> str:
    """Explain why a frame has no time (mid_unix_s is None) and what to do, by the suffix of its source."""
    suffix = Path(source).suffix.lower()
    if suffix in PICTURE + JPEG + RAW:
        vouch = "vouch for its camera's clock (--exif-utc-offset)"
        return f"a {suffix} file carries none in UTC: give FITS, a CSV of centroids, or {vouch}"
    if suffix in (*FITS, ".csv"):
        return "its header needs DATE-OBS with an hour, and EXPTIME: add them"
    return "its header stamp is missing: set it to the middle of the exposure, UTC"

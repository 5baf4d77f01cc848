# SPDX-License-Identifier: Apache-2.0
"""Read frames from files: FITS, TIFF, PNG, JPEG, BMP, HEIF, camera raw; and stars from a CSV of centroids."""

import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from starpos.errors import FrameError, one_line
from starpos.files import bytes_of, open_regular
from starpos.frames.exif import CameraClock
from starpos.frames.exposure import Exposure
from starpos.frames.fits import read_fits
from starpos.frames.frame import MAX_BYTES, Frame, Stars, in_order
from starpos.frames.pictures import heif_frame, picture_frame, raw_frame
from starpos.frames.tables import read_star_list
from starpos.frames.tiff import JPEG_START, PNG_START

FITS = (".fits", ".fit", ".fts", ".fz", ".gz")
PICTURE = (".png", ".tif", ".tiff", ".bmp")
# Next to raw files usually a copy of them.
JPEG = (".jpg", ".jpeg")
HEIF = (".heic", ".heif", ".hif")
RAW = (".cr2", ".cr3", ".nef", ".arw", ".dng", ".raf", ".orf", ".rw2", ".pef")


def read_frame(path: Path | str, clock: CameraClock | None = None) -> Frame | Stars:
    """Read one exposure, or the star list of one; the file's suffix says which.

    docs/reference/files.md has the kinds of files, the cards of FITS that are read, and the form of a list of stars
    (CSV), whose SNR is 1 px / sigma, as for a star image whose standard deviation is 1 px. Row 0 is the first of the
    file. Of several images (HDUs) the first is taken, with a warning; `a.fits[2]` or `a.fits[SCI]` is another one. Three
    planes, and colours of more than 8 bits, become their mean; `frame.to_unsigned` converts other values. The exposure
    of pictures and raw files, and about their focal length, come from EXIF if exifread is installed; their time too, but
    only with a clock.

    Without a time or an exposure mid_unix_s is None, and untimed says why.

    Parameters
    ----------
    path : of the file
    clock : of the camera that wrote the file, if it may be trusted

    Returns
    -------
    Frame or Stars
        the latter for a list of stars

    Raises
    ------
    FrameError
        anything is not as described here

    Examples
    --------
    >>> stars = starpos.read_frame("night/stars_0000.csv")
    >>> stars.width, stars.height
    (1000, 700)
    """
    path = Path(path)
    file_path, part = _part_of(path)
    try:
        with _opened(file_path) as file:
            return _read(file, str(path), file_path.suffix.lower(), part, clock)
    except OSError as e:
        reason = e.strerror or one_line(e)
        raise FrameError(f"{path}: it cannot be read ({reason}); check its permissions and the disk.") from e


def _part_of(path: Path) -> tuple[Path, str]:
    """The file that a path names, and the part of it: a.fits and 2 for `a.fits[2]`."""
    parts = re.fullmatch(r"(.+)\[([\w ,.-]+)\]", str(path))
    if parts is None or Path(parts[1]).suffix.lower() not in FITS or path.exists():
        return path, ""
    return Path(parts[1]), parts[2].strip()


def _read(file: BinaryIO, place: str, suffix: str, part: str, clock: CameraClock | None) -> Frame | Stars:
    """Read an open file as files with this suffix are read."""
    if suffix in FITS:
        return in_order(read_fits(file, place, part)[0])
    if suffix == ".csv":
        return read_star_list(file, place)
    for suffixes, decode in ((PICTURE + JPEG, picture_frame), (HEIF, heif_frame), (RAW, raw_frame)):
        if suffix in suffixes:
            return in_order(decode(bytes_of(file, MAX_BYTES), place, clock))
    known = " ".join(FITS + PICTURE + JPEG + HEIF + RAW + (".csv",))
    raise FrameError(f"{place}: the suffix {suffix!r} is not one of a frame; use one of {known}.")


@contextmanager
def _opened(path: Path) -> Iterator[BinaryIO]:
    """Open a frame's file, as a context manager; FrameError if it is missing, empty or too large.

    OSError if the file may not be read.
    """
    try:
        file = open_regular(path)
    except (FileNotFoundError, NotADirectoryError):
        raise FrameError(f"{one_line(path)}: there is no such file; check the path.") from None
    except IsADirectoryError:
        raise FrameError(
            f"{path}: this is a folder; give the frames in it, like {path / '*.fits'}."
        ) from None
    with file:
        size = file.seek(0, 2)
        file.seek(0)
        if size == 0:
            raise FrameError(f"{path}: the file is empty; take the frame again.")
        if size > MAX_BYTES:
            raise FrameError(f"{path}: it has over {MAX_BYTES // 10**6} MB, too many for a frame.")
        yield file


def are_photographs(paths: Sequence[Path | str]) -> bool:
    """Whether files are of the kinds in which a telephone's photographs, with gravity, come.

    Other files of its folder (screenshots, films) may be among them, but no FITS and no list of stars.
    """
    kinds = {Path(path).suffix.lower() for path in paths}
    return bool(kinds & {*JPEG, *HEIF, *RAW}) and not kinds & {*FITS, ".csv"}


def decode_frame(data: bytes, source: str) -> Frame:
    """Read the bytes a camera sent: JPEG, PNG, TIFF or raw; FrameError if they are not a frame. Its time stays unknown.

    source is the camera's name of the file; its suffix distinguishes a TIFF from a raw file.
    """
    if data.startswith((JPEG_START, PNG_START)) or Path(source).suffix.lower() in PICTURE:
        return picture_frame(data, source)
    return raw_frame(data, source)


def why_no_time(exposure: Exposure) -> str:
    """Explain why a frame has no time (mid_unix_s is None) and what to do: as its file says, else by its suffix."""
    if exposure.untimed:
        return exposure.untimed
    suffix = _part_of(Path(exposure.source))[0].suffix.lower()
    if suffix in PICTURE + JPEG + HEIF + RAW:
        vouch = "vouch for its camera's clock (--exif-utc-offset)"
        return f"a {suffix} file carries none in UTC: give FITS, a CSV of centroids, or {vouch}"
    if suffix in (*FITS, ".csv"):
        return "its header needs DATE-OBS with an hour, and EXPTIME: add them"
    return "its header stamp is missing: set it to the middle of the exposure, UTC"

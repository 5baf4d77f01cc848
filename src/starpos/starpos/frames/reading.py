# SPDX-License-Identifier: Apache-2.0
"""Read frames from files: FITS, TIFF, PNG, JPEG, camera raw; and stars from a CSV of centroids."""

import csv
import json
import stat
from collections.abc import Callable
from pathlib import Path

import numpy as np

from starpos.errors import FrameError, one_line
from starpos.frames.exif import CameraClock
from starpos.frames.fits import read_fits
from starpos.frames.frame import Frame
from starpos.frames.header import focal_px, times
from starpos.frames.pictures import JPEG_START, PNG_START, picture_frame
from starpos.frames.raw import raw_frame
from starpos.frames.stars import Stars

FITS = (".fits", ".fit", ".fts", ".fz", ".gz")
PICTURE = (".png", ".tif", ".tiff")
JPEG = (".jpg", ".jpeg")  # beside raw files usually a copy of them
RAW = (".cr2", ".cr3", ".nef", ".arw", ".dng", ".raf", ".orf", ".rw2", ".pef")
MAX_BYTES, MAX_CSV_BYTES = 2_000_000_000, 20_000_000
DEFAULT_SIGMA_PX = 0.1  # of a centroid whose file has no sigma


def read_frame(path: Path | str, clock: CameraClock | None = None) -> Frame | Stars:
    """Read one exposure, or the star list of one; the file's suffix says which.

    clock is that of the camera which wrote the file, if it may be trusted.

    FITS (also .fz and .gz): DATE-OBS (or DATE-BEG, MJD-OBS, MJD-BEG) is the start of the exposure in UTC (or in
    TIMESYS), EXPTIME or EXPOSURE its length in s; BAYERPAT (XBAYROFF, YBAYROFF) is the mosaic; FOCALLEN (mm) and XPIXSZ
    (um) give focal_px. The first row of the file is row 0. Values that fit 16 bits are only rounded. Others are shifted
    to begin at 0, and scaled to fill 16 bits if their range is wider than that or, for floats, narrower than 4096. A few
    NaN or infinite pixels become the median. Values farther from it than any light (frame.LOUDEST) are clipped.
    TIFF, PNG, JPEG: 8 or 16 bits, grey or colour. 16-bit colour is scaled down to bgr8.
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
        _check_file(path)
        return _reader_of(path)(path, clock)
    except OSError as e:
        reason = e.strerror or one_line(e)
        raise FrameError(f"{path}: it cannot be read ({reason}); check its permissions and the disk.") from e


def _check_file(path: Path) -> None:
    """Raise FrameError or OSError unless the path is a file that is not empty and can be opened."""
    try:
        status = path.stat()
    # ValueError: the name contains a NUL
    except (FileNotFoundError, NotADirectoryError, ValueError):
        raise FrameError(f"{one_line(path)}: there is no such file; check the path.") from None
    if stat.S_ISDIR(status.st_mode):
        raise FrameError(f"{path}: this is a folder; give the frames in it, like {path / '*.fits'}.")
    if not stat.S_ISREG(status.st_mode):
        raise FrameError(f"{path}: this is no regular file but a device or a pipe; give a frame's file.")
    if status.st_size == 0:
        raise FrameError(f"{path}: the file is empty; take the frame again.")
    # a file without permission to read would otherwise be reported as a damaged image
    path.open("rb").close()


def _reader_of(path: Path) -> Callable[[Path, CameraClock | None], Frame | Stars]:
    """The function of path and clock that reads files with this suffix."""
    suffix = path.suffix.lower()
    for suffixes, reader in (
        (FITS, lambda path, _: read_fits(path)),
        (PICTURE + JPEG, lambda path, clock: picture_frame(_bytes_of(path), str(path), clock)),
        (RAW, lambda path, clock: raw_frame(_bytes_of(path), str(path), clock)),
        ((".csv",), lambda path, _: _read_csv(path)),
    ):
        if suffix in suffixes:
            return reader
    known = " ".join(FITS + PICTURE + JPEG + RAW + (".csv",))
    raise FrameError(f"{path}: the suffix {suffix!r} is not one of a frame; use one of {known}.")


def _bytes_of(path: Path) -> bytes:
    _check_size(path, MAX_BYTES)
    return path.read_bytes()


def _check_size(path: Path, most: int) -> None:
    if path.stat().st_size > most:
        raise FrameError(f"{path}: it is larger than {most // 10**6} MB, too large for a frame.")


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


def _read_csv(path: Path) -> Stars:
    _check_size(path, MAX_CSV_BYTES)
    try:
        text = path.read_text(encoding="utf-8")
    except UnicodeDecodeError:
        raise FrameError(f"{path}: this is not a text file; give a CSV of centroids.") from None
    first, _, rest = text.partition("\n")
    try:
        header = json.loads(first.removeprefix("#"))
        width, height = header["NAXIS1"], header["NAXIS2"]
        if not first.startswith("#") or not isinstance(width, int) or not isinstance(height, int):
            raise ValueError
    except (ValueError, KeyError, TypeError, RecursionError):
        line = '# {"NAXIS1": 5616, "NAXIS2": 3744, "DATE-OBS": "...", "EXPTIME": 0.5}'
        raise FrameError(
            f"{path}: its first line does not give the frame's size; write it like {line}."
        ) from None
    try:
        rows = [row for row in csv.reader(rest.splitlines()) if row]
    except csv.Error as e:
        raise FrameError(f"{path}: this is not a CSV ({one_line(e)}); write one star a line.") from None
    names = [name.strip().lower() for name in rows[0]] if rows else []
    if not {"x", "y", "flux"} <= set(names):
        raise FrameError(
            f"{path}: its second line names the columns {names}; it must name x, y, flux and may sigma."
        )
    try:
        table = np.array([[float(cell) for cell in row] for row in rows[1:]]).reshape(-1, len(names))
        if len(table) != len(rows) - 1:
            raise ValueError
    except ValueError:
        raise FrameError(f"{path}: a row is not {len(names)} numbers; write one star a line.") from None
    column = dict(zip(names, table.T, strict=True))
    sigma = column.get("sigma", np.full(len(table), DEFAULT_SIGMA_PX))
    if not np.all((sigma > 0) & (sigma < 1e3)):
        raise FrameError(
            f"{path}: a star's sigma is not between 0 and 1000 px; correct or remove the column."
        )
    order = np.argsort(-column["flux"], kind="stable")
    mid, exposure, rounding = times(header, str(path))
    return Stars(
        x=column["x"][order],
        y=column["y"][order],
        flux=column["flux"][order],
        snr=1.0 / sigma[order],
        covariance=(sigma[order] ** 2)[:, None, None] * np.eye(2),
        flags=np.zeros(len(table)),
        width=width,
        height=height,
        mid_unix_s=mid,
        exposure_s=exposure,
        source=str(path),
        focal_px=focal_px(header),
        stamp_stddev_s=rounding,
    )

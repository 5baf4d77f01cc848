# SPDX-License-Identifier: Apache-2.0
"""Files to frames: FITS, TIFF, PNG, camera raw; and a CSV of centroids to stars."""

import csv
import json
import stat
import struct
import zlib
from pathlib import Path

import numpy as np

from starpos.errors import FrameError, one_line
from starpos.fits_frame import read_fits
from starpos.frame import MAX_PIXELS, Frame, to_unsigned
from starpos.frame_header import focal_px, times
from starpos.stars import Stars

FITS = (".fits", ".fit", ".fts", ".fz", ".gz")
PICTURE = (".png", ".tif", ".tiff")
RAW = (".cr2", ".cr3", ".nef", ".arw", ".dng", ".raf", ".orf", ".rw2", ".pef")
PNG = b"\x89PNG\r\n\x1a\n"
DEFAULT_SIGMA_PX = 0.1  # of a centroid whose file has no sigma


def read_frame(path) -> Frame | Stars:
    """Read one exposure, or the star list of one, by the file's suffix.

    FITS (also .fz and .gz): DATE-OBS (or DATE-BEG, MJD-OBS, MJD-BEG) is the start of the exposure in UTC (or
    in TIMESYS), EXPTIME or EXPOSURE its length in s; BAYERPAT the mosaic; FOCALLEN (mm) and XPIXSZ (um) give
    focal_px. The first row of the file is row 0. Values that fit 16 bits stay, rounded; others are shifted
    to begin at 0, and scaled to fill 16 bits where their range is wider than that or, of floats, narrower
    than 4096. A few NaN or infinite pixels become the median.
    TIFF, PNG: 8 or 16 bits, grey or colour; they carry no time. 16-bit colour is scaled down to bgr8.
    Camera raw: the mosaic as the sensor gave it, through rawpy. A camera's clock is local time of an unknown
    zone, so the time stays unknown.
    CSV: a first line `# {"NAXIS1": ..., "NAXIS2": ..., "DATE-OBS": ..., "EXPTIME": ...}` of which the NAXIS
    pair is required, then columns x, y, flux and perhaps sigma (px); without it sigma is 0.1 px. The SNR is
    1 px / sigma, that of a star image whose standard deviation is 1 px.

    A missing time or exposure leaves mid_unix_s None. Raises FrameError for anything else not as above.
    """
    path = Path(path)
    try:
        _check_file(path)
        return _reader_of(path)(path)
    except OSError as e:
        reason = e.strerror or one_line(e)
        raise FrameError(f"{path}: it cannot be read ({reason}); check its permissions and the disk.") from e


def _check_file(path):
    """FrameError or OSError unless this is a file with something in it that opens."""
    try:
        status = path.stat()
    except (FileNotFoundError, NotADirectoryError, ValueError):  # ValueError: a NUL in the name
        raise FrameError(f"{one_line(path)}: there is no such file; check the path.") from None
    if stat.S_ISDIR(status.st_mode):
        raise FrameError(f"{path}: this is a folder; give the frames in it, like {path / '*.fits'}.")
    if not stat.S_ISREG(status.st_mode):
        raise FrameError(f"{path}: this is no regular file but a device or a pipe; give a frame's file.")
    if status.st_size == 0:
        raise FrameError(f"{path}: the file is empty; take the frame again.")
    path.open("rb").close()  # a refusal here is told as what it is, not as a damaged image


def _reader_of(path):
    """The function that reads files of this suffix."""
    suffix = path.suffix.lower()
    for suffixes, reader in (
        (FITS, read_fits),
        (PICTURE, _read_picture),
        (RAW, _read_raw),
        ((".csv",), _read_csv),
    ):
        if suffix in suffixes:
            return reader
    known = " ".join(FITS + PICTURE + RAW + (".csv",))
    raise FrameError(f"{path}: the suffix {suffix!r} is not one of a frame; use one of {known}.")


def why_no_time(source: str) -> str:
    """What a frame lacks whose mid_unix_s is None, and what to do: by the suffix of the file it came from."""
    suffix = Path(source).suffix.lower()
    if suffix in PICTURE + RAW:
        return f"a {suffix} file carries none in UTC: give FITS, or a CSV of centroids"
    if suffix in (*FITS, ".csv"):
        return "its header needs DATE-OBS with an hour, and EXPTIME: add them"
    return "its header stamp is missing: set it to the middle of the exposure, UTC"


def _read_picture(path):
    size = _picture_size(path)
    if size is None:
        raise FrameError(f"{path}: this is not a PNG or TIFF image; give one, or FITS.")
    if size[0] * size[1] > MAX_PIXELS:
        raise FrameError(
            f"{path}: its header claims {size[0]} x {size[1]} pixels; a frame has 1 to {MAX_PIXELS}."
        )
    data = path.read_bytes()
    if data.startswith(PNG):
        data = _png_image(data)
    pixels = decode_picture(data)
    if pixels is None:
        raise FrameError(f"{path}: this is not a whole PNG or TIFF image; take or copy it again.")
    if pixels.ndim == 3:
        pixels = pixels[:, :, :3]  # without the alpha channel
        if pixels.shape[2] < 3:
            pixels = np.ascontiguousarray(pixels[:, :, 0])
        elif pixels.dtype == np.uint16:
            pixels = (pixels >> 8).astype(np.uint8)
        pixels = np.ascontiguousarray(pixels)
    if pixels.ndim == 2:
        pixels = to_unsigned(pixels, path)
    return Frame(pixels, source=str(path))


def decode_picture(data: bytes) -> np.ndarray | None:
    """A PNG's or TIFF's pixels as they are, None where they cannot be decoded; nothing is printed."""
    import cv2

    log = getattr(cv2.utils, "logging", cv2)  # OpenCV 4.6 has it at the top
    level = log.setLogLevel(0)
    try:
        return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        return None
    finally:
        log.setLogLevel(level)


def _picture_size(path):
    """(width, height) a PNG's or TIFF's header claims, before a decoder makes room for it; None: neither."""
    with open(path, "rb") as file:
        head = file.read(24)
        if head.startswith(PNG) and len(head) == 24:
            return struct.unpack(">II", head[16:24])
        order = {b"II*\0": "<", b"MM\0*": ">"}.get(head[:4])
        if order is None or len(head) < 8:
            return None
        file.seek(struct.unpack(order + "I", head[4:8])[0])
        count = file.read(2)
        entries = file.read(12 * struct.unpack(order + "H", count)[0]) if len(count) == 2 else b""
    size = {}
    for tag, kind, _, value in struct.iter_unpack(order + "HHI4s", entries[: len(entries) // 12 * 12]):
        if tag in (256, 257):  # ImageWidth, ImageLength: SHORT or LONG
            size[tag] = struct.unpack(order + ("H" if kind == 3 else "I"), value[: 2 if kind == 3 else 4])[0]
    return (size[256], size[257]) if len(size) == 2 else None


def _png_image(data):
    """The chunks of a PNG that make its image, b"" where one is damaged or the last is missing.

    libpng prints on standard error about damage, and about such things as colour profiles: it gets neither.
    """
    kept, at = [PNG], len(PNG)
    while at + 12 <= len(data):
        (length,) = struct.unpack_from(">I", data, at)
        chunk = data[at : at + 12 + length]
        at += 12 + length
        if at > len(data) or struct.pack(">I", zlib.crc32(chunk[4:-4])) != chunk[-4:]:
            return b""
        if chunk[4:5].isupper():  # critical
            kept.append(chunk)
        if chunk[4:8] == b"IEND":
            return b"".join(kept)
    return b""


def _read_raw(path):
    try:
        import rawpy
    except ImportError:
        raise FrameError(
            f"{path}: reading a camera's raw file needs rawpy; run `pip install rawpy`."
        ) from None
    try:
        with rawpy.imread(str(path)) as raw:
            pixels = raw.raw_image_visible.copy()
            colours = raw.color_desc.decode("ascii", "replace")
            pattern = "".join(colours[i] for i in np.ravel(raw.raw_pattern)).lower()
    except (rawpy.LibRawError, OSError, ValueError, TypeError, IndexError) as e:
        raise FrameError(f"{path}: this is not a whole raw file ({one_line(e)}); copy it again.") from e
    if pattern not in ("rggb", "bggr", "grbg", "gbrg"):
        raise FrameError(
            f"{path}: its colour mosaic is {pattern!r}, not a 2 x 2 Bayer one; convert it to TIFF."
        )
    return Frame(to_unsigned(pixels, path), pattern, source=str(path))


def _read_csv(path):
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
    mid, exposure = times(header, path)
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
    )

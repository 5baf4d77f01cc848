# SPDX-License-Identifier: Apache-2.0
"""Files to frames: FITS, TIFF, PNG, camera raw; and a CSV of centroids to stars."""

import csv
import json
import re
import stat
import struct
import warnings
import zlib
from pathlib import Path

import numpy as np

from starpos.errors import FrameError
from starpos.frame import Frame
from starpos.stars import Stars

FITS = (".fits", ".fit", ".fts", ".fz", ".gz")
PICTURE = (".png", ".tif", ".tiff")
RAW = (".cr2", ".cr3", ".nef", ".arw", ".dng", ".raf", ".orf", ".rw2", ".pef")
PNG = b"\x89PNG\r\n\x1a\n"
START = ("DATE-OBS", "DATE-BEG", "MJD-OBS", "MJD-BEG")
KEYS = (*START, "TIME-OBS", "TIMESYS", "EXPTIME", "EXPOSURE", "BAYERPAT", "FOCALLEN", "XPIXSZ")
SCALES = ("utc", "tai", "tt", "tdb")  # of TIMESYS; UT1 would need tables
FITS_TROUBLE = (OSError, ValueError, TypeError, LookupError, AttributeError, ArithmeticError, MemoryError)
MAX_PIXELS = 200_000_000  # a header may claim anything; this much fits a small robot's memory
MAX_EXPOSURE_S = 86400.0
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
        reason = e.strerror or _one_line(e)
        raise FrameError(f"{path}: it cannot be read ({reason}); check its permissions and the disk.") from e


def _check_file(path):
    """FrameError or OSError unless this is a file with something in it that opens."""
    try:
        status = path.stat()
    except (FileNotFoundError, NotADirectoryError, ValueError):  # ValueError: a NUL in the name
        raise FrameError(f"{_one_line(path)}: there is no such file; check the path.") from None
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
        (FITS, _read_fits),
        (PICTURE, _read_picture),
        (RAW, _read_raw),
        ((".csv",), _read_csv),
    ):
        if suffix in suffixes:
            return reader
    known = " ".join(FITS + PICTURE + RAW + (".csv",))
    raise FrameError(f"{path}: the suffix {suffix!r} is not one of a frame; use one of {known}.")


def _read_fits(path):
    from astropy.io import fits

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with fits.open(path, memmap=False, lazy_load_hdus=True) as hdus:
                header, values = _first_image(hdus, path)
    except (*FITS_TROUBLE, fits.VerifyError) as e:
        raise FrameError(
            f"{path}: this is not a whole FITS image ({_one_line(e)}); take or copy it again."
        ) from e
    pixels = _to_unsigned(values, path)
    mid, exposure = _times(header, path)
    pattern = str(header.get("BAYERPAT", "")).strip().lower()
    if pattern not in ("", "rggb", "bggr", "grbg", "gbrg"):
        raise FrameError(f"{path}: BAYERPAT is {pattern!r}; it must be RGGB, BGGR, GRBG or GBRG.")
    return Frame(pixels, pattern, mid, exposure, str(path), _focal_px(header))


def _first_image(hdus, path):
    """Header (a dict of KEYS) and data (h, w) of the first HDU that holds an image."""
    for hdu in hdus:
        shape = [int(n) for n in hdu.shape] if hdu.is_image else []
        if not shape:
            continue
        if len(shape) != 2 and not (len(shape) > 2 and max(shape[:-2]) == 1):
            size = " x ".join(map(str, reversed(shape)))
            raise FrameError(
                f"{path}: the image has {len(shape)} axes ({size}); give one monochrome plane a file."
            )
        if min(shape) < 1 or shape[-1] * shape[-2] > MAX_PIXELS:
            raise FrameError(
                f"{path}: its header claims {shape[-1]} x {shape[-2]} pixels; a frame has 1 to {MAX_PIXELS}."
            )
        header = {key: hdu.header[key] for key in KEYS if key in hdu.header}
        return header, np.asarray(hdu.data).reshape(shape[-2:])
    raise FrameError(f"{path}: there is no image in this FITS file; give one that holds a frame.")


def _to_unsigned(values, path):
    """uint8 or uint16 (h, w) of any real values; the rule is read_frame's."""
    if values.dtype.kind not in "uif":
        raise FrameError(f"{path}: its pixels are {values.dtype}; give numbers.")
    if values.dtype.kind == "u" and values.dtype.itemsize <= 2:
        return np.ascontiguousarray(values, values.dtype.newbyteorder("="))
    if values.dtype.kind == "f":
        finite = np.isfinite(values)
        if finite.mean() < 0.99:
            raise FrameError(f"{path}: more than 1 % of its pixels are NaN or infinite; mask fewer of them.")
        if not finite.all():
            values = np.where(finite, values, np.median(values[finite]))
    low, high = float(values.min()), float(values.max())
    span = high - low
    narrow = values.dtype.kind == "f" and 0 < span < 4096
    if not np.isfinite(span):
        raise FrameError(f"{path}: its pixels span {low:g} to {high:g}; rescale them to 16 bits.")
    if low >= 0 and high <= 65535 and not narrow:
        offset, scale = 0.0, 1.0
    else:
        offset, scale = low, (65535 / span if narrow or span > 65535 else 1.0)
    out = np.empty(values.shape, np.uint16)
    for row in range(0, len(values), 256):  # strips: a float64 copy of a whole frame is 170 MB
        out[row : row + 256] = np.rint((values[row : row + 256].astype(np.float64) - offset) * scale)
    return out


def _times(header, path):
    """Middle of the exposure (Unix time, UTC) and its length in s, each None where the header has none."""
    exposure = next((header[k] for k in ("EXPTIME", "EXPOSURE") if header.get(k) not in (None, "")), None)
    if exposure is not None:
        try:
            exposure = float(exposure)
        except (TypeError, ValueError, OverflowError):
            exposure = np.nan
        if not 0 <= exposure <= MAX_EXPOSURE_S:
            raise FrameError(
                f"{path}: its exposure (EXPTIME) is not 0 to {MAX_EXPOSURE_S:.0f} s; correct the header."
            )
    key = next((k for k in START if header.get(k) not in (None, "")), None)
    if key is None or exposure is None:
        return None, exposure
    start = header[key]
    if key == "DATE-OBS" and "T" not in str(start) and header.get("TIME-OBS"):
        start = f"{start}T{header['TIME-OBS']}"
    if isinstance(start, str) and re.fullmatch(r"\d{4}-\d\d-\d\d", start.strip()):
        return None, exposure  # a day without an hour is no time
    scale = str(header.get("TIMESYS", "UTC")).strip().lower()
    if scale not in SCALES:
        raise FrameError(f"{path}: its TIMESYS is {scale!r}; it must be one of {', '.join(SCALES)}.")
    return _middle(start, exposure, scale, f"{path}: its {key}"), exposure


def _middle(start, exposure_s, scale, what):
    """Unix time of start (ISO 8601 text or an MJD) + exposure / 2, counted in TAI: safe at a leap second."""
    from astropy.utils import iers

    iers.conf.auto_download = False  # before astropy.time is imported, which looks for leap seconds
    from astropy.time import Time, TimeDelta

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            if isinstance(start, str):
                begin = Time(start.strip().removesuffix("Z"), format="isot", scale=scale)
            else:
                begin = Time(float(start), format="mjd", scale=scale)
            unix = float((begin.utc + TimeDelta(exposure_s / 2, format="sec")).unix)
    except (ValueError, TypeError, OverflowError):
        unix = np.nan
    if not np.isfinite(unix):
        raise FrameError(f"{what} is {start!r}, which is no time; write it like 2026-11-02T18:00:00.000.")
    return unix


def why_no_time(source: str) -> str:
    """What a frame lacks whose mid_unix_s is None, and what to do: by the suffix of the file it came from."""
    suffix = Path(source).suffix.lower()
    if suffix in PICTURE + RAW:
        return f"a {suffix} file carries none in UTC: give FITS, or a CSV of centroids"
    if suffix in (*FITS, ".csv"):
        return "its header needs DATE-OBS with an hour, and EXPTIME: add them"
    return "its header stamp is missing: set it to the middle of the exposure, UTC"


def _focal_px(header):
    """FOCALLEN (mm) / XPIXSZ (um) in px; None where one is missing or senseless: it is but a hint."""
    try:
        focal = float(header["FOCALLEN"]) * 1000.0 / float(header["XPIXSZ"])
    except (KeyError, TypeError, ValueError, ArithmeticError):
        return None
    return focal if np.isfinite(focal) and focal > 0 else None


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
        pixels = _to_unsigned(pixels, path)
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
        raise FrameError(f"{path}: this is not a whole raw file ({_one_line(e)}); copy it again.") from e
    if pattern not in ("rggb", "bggr", "grbg", "gbrg"):
        raise FrameError(
            f"{path}: its colour mosaic is {pattern!r}, not a 2 x 2 Bayer one; convert it to TIFF."
        )
    return Frame(_to_unsigned(pixels, path), pattern, source=str(path))


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
        raise FrameError(f"{path}: this is not a CSV ({_one_line(e)}); write one star a line.") from None
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
    mid, exposure = _times(header, path)
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
        focal_px=_focal_px(header),
    )


def _one_line(error):
    return " ".join(str(error).split())[:120] or type(error).__name__

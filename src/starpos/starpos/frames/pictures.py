# SPDX-License-Identifier: Apache-2.0
"""Read frames from the bytes of PNG, TIFF, JPEG, BMP and HEIF pictures and of cameras' raw files."""

import io
import struct
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from types import ModuleType
from typing import Any

import numpy as np

from starpos.errors import FrameError, one_line
from starpos.frames import exif
from starpos.frames.frame import PATTERNS, Frame, check_pixels, to_unsigned
from starpos.frames.tiff import JPEG_START, ORDERS, PNG_START, TIFF_ORDERS, tiff_directory

BMP_START = b"BM"
# Segments of a JPEG that hold its size, and the one where its image begins.
SIZED = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
SCAN = 0xDA
# Samples of a decoded pixel by a PNG's type of colour: grey, colour, palette, grey with alpha, colour with alpha.
PNG_SAMPLES = {0: 1, 2: 3, 3: 3, 4: 4, 6: 4}
# Tags of TIFF 6.0.
WIDTH, HEIGHT, BITS, SAMPLES, ORIENTATION = 256, 257, 258, 277, 274


def picture_frame(data: bytes, place: str, clock: exif.CameraClock | None = None) -> Frame:
    """Read the bytes of a PNG, TIFF, JPEG or BMP by the rules of `reading.read_frame`; FrameError for anything else.

    place says where the bytes came from, for messages; clock: of the camera, if it may be trusted.
    """
    pixels = picture_pixels(data, place)
    return Frame(pixels, **exif.read_exposure(data, place, clock, pixels.shape).facts)


def picture_pixels(data: bytes, place: str) -> np.ndarray:
    """The pixels of a Frame from the bytes of a PNG, TIFF, JPEG or BMP; FrameError for anything else."""
    size = _size(data)
    if size is None:
        raise FrameError(f"{place}: this is not a whole PNG, TIFF, JPEG or BMP image; give one, or FITS.")
    check_pixels(*size, place)
    pixels = decode_picture(_png_image(data) if data.startswith(PNG_START) else _not_turned_tiff(data))
    if pixels is None:
        raise FrameError(f"{place}: this is not a whole PNG, TIFF, JPEG or BMP image; take or copy it again.")
    return frame_pixels(pixels, place)


def frame_pixels(pixels: np.ndarray, place: str) -> np.ndarray:
    """Pixels (h, w) or (h, w, channels) of a picture in the form that a Frame has; FrameError if they are not numbers."""
    import cv2

    if pixels.ndim == 3:
        # without the alpha channel
        pixels = pixels[:, :, : 3 if pixels.shape[2] >= 3 else 1]
        if pixels.shape[2] == 3 and pixels.dtype == np.uint8:
            return np.ascontiguousarray(pixels)
        # the faint stars of deep colours would be lost in 8 bits
        channels = pixels.shape[2]
        pixels = cv2.transform(np.ascontiguousarray(pixels), np.full((1, channels), 1 / channels))
    return to_unsigned(pixels, place)


def decode_picture(data: bytes) -> np.ndarray | None:
    """The pixels of a PNG, TIFF or JPEG as they are, None if they cannot be decoded; nothing is printed."""
    with quiet_opencv() as cv2:
        try:
            return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
        except cv2.error:
            return None


@contextmanager
def quiet_opencv() -> Iterator[ModuleType]:
    """Import cv2 and keep it from printing meanwhile: our own sentences report the errors."""
    import cv2

    # OpenCV 4.6 has setLogLevel at the top
    log: Any = getattr(cv2.utils, "logging", cv2)
    level = log.setLogLevel(0)
    try:
        yield cv2
    finally:
        log.setLogLevel(level)


def _size(data: bytes) -> tuple[int, int, float] | None:
    """Width, height and bytes of a pixel by the header, known before a decoder reserves memory for them.

    None if this is not a picture.
    """
    try:
        if data.startswith(PNG_START):
            width, height, bits, colour = struct.unpack_from(">IIBB", data, 16)
            return width, height, PNG_SAMPLES.get(colour, 4) * max(bits, 8) / 8
        if data.startswith(BMP_START):
            return _bmp_size(data)
        return _jpeg_size(data) if data.startswith(JPEG_START) else _tiff_size(data)
    # the data end too early
    except struct.error:
        return None


def _bmp_size(data: bytes) -> tuple[int, int, float] | None:
    """Width, height and bytes of a decoded pixel of a BMP by its header; None if its end is missing."""
    length, _, start, _, width, height, _, bits, packing = struct.unpack_from("<IIIIiiHHI", data, 2)
    # rows that run top-down have a negative height
    width, height = max(0, width), abs(height)
    # rows end at multiples of 4 bytes; packed ones have any length
    whole = start + (width * bits + 31) // 32 * 4 * height if packing in (0, 3) else length
    return (width, height, max(bits, 24) / 8) if len(data) >= whole else None


def _tiff_size(data: bytes) -> tuple[int, int, float] | None:
    """Width, height and bytes of a pixel of a TIFF by its header; None if this is not one."""
    order = TIFF_ORDERS.get(data[:4])
    if order is None:
        return None
    (at,) = struct.unpack_from(order + "I", data, 4)
    tags, _ = tiff_directory(data, at, order, (WIDTH, HEIGHT, BITS, SAMPLES), 1)
    if not {WIDTH, HEIGHT} <= tags.keys() or any(
        isinstance(v, float) for values in tags.values() for v in values
    ):
        return None
    # one sample of one bit, unless the file says more
    (width,), (height,), (bits,), (samples,) = (tags.get(tag, (1,)) for tag in (WIDTH, HEIGHT, BITS, SAMPLES))
    return width, height, samples * max(bits, 8) / 8


def _not_turned_tiff(data: bytes) -> bytes:
    """A TIFF with the Orientation 1, by which a decoder leaves rows and columns as they are stored; others unchanged."""
    order = TIFF_ORDERS.get(data[:4])
    if order is None:
        return data
    (at,) = struct.unpack_from(order + "I", data, 4)
    (count,) = struct.unpack_from(order + "H", data, at)
    for entry in range(at + 2, at + 2 + 12 * count, 12):
        tag, kind, n, value = struct.unpack_from(order + "HHIH", data, entry)
        if (tag, kind, n) == (ORIENTATION, 3, 1) and value != 1:
            data = data[: entry + 8] + struct.pack(order + "H", 1) + data[entry + 10 :]
    return data


def _jpeg_size(data: bytes) -> tuple[int, int, float] | None:
    """Width, height and bytes of a pixel of a JPEG by its header.

    None also if the end is missing, which a decoder would fill with grey.
    """
    at, size = 2, None
    while data[at : at + 1] == b"\xff":
        (kind,) = struct.unpack_from("B", data, at + 1)
        # padding
        if kind == 0xFF:
            at += 1
            continue
        if kind == SCAN:
            return size if data.find(b"\xff\xd9", at) >= 0 else None
        if kind in SIZED:
            height, width, samples = struct.unpack_from(">HHB", data, at + 5)
            size = width, height, float(samples)
        at += 2 + struct.unpack_from(">H", data, at + 2)[0]
    return None


def _png_image(data: bytes) -> bytes:
    """A PNG with only the chunks that its image needs; b"" if one is damaged or the last is missing.

    libpng would print messages about damage, and about other chunks, such as colour profiles, on standard error.
    """
    kept, at = [PNG_START], len(PNG_START)
    while at + 12 <= len(data):
        (length,) = struct.unpack_from(">I", data, at)
        chunk = data[at : at + 12 + length]
        at += 12 + length
        if at > len(data) or struct.pack(">I", zlib.crc32(chunk[4:-4])) != chunk[-4:]:
            return b""
        # critical chunks begin with a capital letter
        if chunk[4:5].isupper():
            kept.append(chunk)
        if chunk[4:8] == b"IEND":
            return b"".join(kept)
    return b""


def heif_frame(data: bytes, place: str, clock: exif.CameraClock | None = None) -> Frame:
    """Read the first picture of a HEIF file by the rules of `reading.read_frame`; FrameError if it is not one.

    Its rows and columns are the sensor's, as in a JPEG, however the camera was held.
    place says where the bytes came from, for messages; clock: of the camera, if it may be trusted.
    """
    try:
        import pillow_heif
    except ImportError:
        raise FrameError(
            f"{place}: reading HEIF needs pillow-heif; run `pip install pillow-heif`, or save it as JPEG."
        ) from None
    try:
        picture = pillow_heif.open_heif(
            io.BytesIO(_not_turned_heif(data)), convert_hdr_to_8bit=False, bgr_mode=True
        )
        # it is unpacked only after this
        width, height = picture.size
        check_pixels(width, height, 8.0 if ";16" in picture.mode else 4.0, place)
        pixels = np.array(picture)
        # a TIFF, behind its name
        tags = (picture.info.get("exif") or b"").removeprefix(b"Exif\0\0")
    except FrameError:
        raise
    # damaged bytes make libheif raise any kind of exception
    except Exception as e:
        raise FrameError(f"{place}: this is not a whole HEIF picture ({one_line(e)}); copy it again.") from e
    pixels = frame_pixels(pixels, place)
    return Frame(pixels, **exif.read_exposure(tags, place, clock, pixels.shape).facts)


# Boxes of a HEIF (ISO/IEC 23008-12) that turn a picture by quarters, and mirror it: each holds one byte.
TURN, MIRROR = b"irot", b"imir"


def _not_turned_heif(data: bytes) -> bytes:
    """The file with turns of 0 in place of those by which a decoder would show the picture upright.

    Without them the rows and columns are those that the camera encoded.
    """
    inside = [(0, len(data))]
    for name, skip in ((b"meta", 4), (b"iprp", 0), (b"ipco", 0)):
        inside = [
            (begin + skip, end) for part in inside for kind, begin, end in _boxes(data, *part) if kind == name
        ]
    for part in inside:
        for kind, begin, end in _boxes(data, *part):
            if kind in (TURN, MIRROR) and end - begin == 1:
                data = data[: begin - 4] + TURN + b"\0" + data[end:]
    return data


def _boxes(data: bytes, at: int, end: int) -> Iterator[tuple[bytes, int, int]]:
    """Kind, begin and end of the content of each box between two offsets; it ends at a damaged one."""
    while at + 8 <= end:
        length, head = int.from_bytes(data[at : at + 4], "big"), 8
        if length == 1:
            length, head = int.from_bytes(data[at + 8 : at + 16], "big"), 16
        following = end if length == 0 else at + length
        if not at + head <= following <= end:
            return
        yield data[at + 4 : at + 8], at + head, following
        at = following


# Tags of TIFF 6.0: offsets and lengths of an image's strips, the same of its tiles, and the IFDs below this one.
STRIPS, TILES, BELOW = (273, 279), (324, 325), 330
MAX_IFDS, MAX_VALUES = 64, 1 << 20


def raw_frame(data: bytes, place: str, clock: exif.CameraClock | None = None) -> Frame:
    """Read the mosaic as the sensor gave it, with its pattern, from the bytes of a raw file; FrameError if it is not one.

    place says where the bytes came from, for messages; clock: of the camera, if it may be trusted.
    """
    try:
        import rawpy
    except ImportError:
        raise FrameError(
            f"{place}: reading a camera's raw file needs rawpy; run `pip install rawpy`."
        ) from None
    try:
        # LibRaw would fill the missing end of some formats with zeros
        if _end(data) > len(data):
            raise ValueError("it breaks off")
        with rawpy.RawPy() as raw:
            raw.open_buffer(io.BytesIO(data))
            # LibRaw unpacks to 16 bits
            check_pixels(raw.sizes.raw_width, raw.sizes.raw_height, 2, place)
            raw.unpack()
            pixels = raw.raw_image_visible.copy()
            # no sensor gives a row of zeros
            if not pixels[-1].any():
                raise ValueError("its last row is empty")
            colours = raw.color_desc.decode("ascii", "replace")
            try:
                pattern = "".join(colours[i] for i in np.ravel(raw.raw_pattern)).lower()
            # a mosaic that rawpy does not know; sometimes a damaged file
            except NotImplementedError as e:
                pattern = str(e)
    except (rawpy.LibRawError, OSError, ValueError, TypeError, IndexError, AttributeError) as e:
        raise FrameError(f"{place}: this is not a whole raw file ({_words(e)}); copy it again.") from e
    if pattern not in PATTERNS or not pattern:
        raise FrameError(
            f"{place}: its colour mosaic is {pattern!r}, not a 2 x 2 Bayer one; convert it to TIFF."
        )
    exposure = exif.read_exposure(data, place, clock, pixels.shape)
    # the sensor's own pixels are all here, whatever shape the camera gave to its pictures
    exposure = replace(exposure, origin_px=None)
    return Frame(to_unsigned(pixels, place), pattern=pattern, **exposure.facts)


def _words(error: Exception) -> str:
    """Message of an exception; LibRaw's messages are bytes."""
    first = error.args[0] if error.args else ""
    return one_line(first.decode("ascii", "replace") if isinstance(first, bytes) else error)


def _end(data: bytes) -> int:
    """Offset of the end of the last strip or tile in a file built like TIFF (CR2, DNG, NEF ...); 0 for other files."""
    order = ORDERS.get(data[:2])
    if order is None or len(data) < 8:
        return 0
    seen: set[int] = set()
    waiting, end = [struct.unpack_from(order + "I", data, 4)[0]], 0
    while waiting and len(seen) < MAX_IFDS:
        at = waiting.pop()
        if at in seen or not at:
            continue
        seen.add(at)
        try:
            tags, following = tiff_directory(data, at, order, (*STRIPS, *TILES, BELOW), MAX_VALUES)
        except (struct.error, TypeError):
            continue
        waiting += [following, *tags.get(BELOW, ())]
        for offsets, lengths in (STRIPS, TILES):
            parts = zip(tags.get(offsets, ()), tags.get(lengths, ()), strict=False)
            end = max([end, *(sum(part) for part in parts)])
    return end

# SPDX-License-Identifier: Apache-2.0
"""Read frames from the bytes of PNG, TIFF, JPEG and BMP files."""

import struct
import zlib

import numpy as np

from starpos.errors import FrameError
from starpos.frames import exif
from starpos.frames.files import check_pixels
from starpos.frames.frame import Frame, to_unsigned

PNG_START = b"\x89PNG\r\n\x1a\n"
JPEG_START = b"\xff\xd8\xff"
BMP_START = b"BM"
# Segments of a JPEG that hold its size, and the one where its image begins.
SIZED = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
SCAN = 0xDA
# Samples of a decoded pixel by a PNG's type of colour: grey, colour, palette, grey with alpha, colour with alpha.
PNG_SAMPLES = {0: 1, 2: 3, 3: 3, 4: 4, 6: 4}
# Tags of TIFF 6.0.
WIDTH, HEIGHT, BITS, SAMPLES = 256, 257, 258, 277


def picture_frame(data: bytes, place: str, clock: exif.CameraClock | None = None) -> Frame:
    """Read the bytes of a PNG, TIFF, JPEG or BMP by the rules of `reading.read_frame`; FrameError for anything else.

    place says where the bytes came from, for messages; clock: of the camera, if it may be trusted.
    """
    pixels = picture_pixels(data, place)
    return Frame(pixels, source=place, **exif.told(data, place, clock, pixels.shape))


def picture_pixels(data: bytes, place: str) -> np.ndarray:
    """The pixels of a Frame from the bytes of a PNG, TIFF, JPEG or BMP; FrameError for anything else."""
    size = _size(data)
    if size is None:
        raise FrameError(f"{place}: this is not a whole PNG, TIFF, JPEG or BMP image; give one, or FITS.")
    check_pixels(*size, place)
    pixels = decode_picture(_png_image(data) if data.startswith(PNG_START) else data)
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
    import cv2

    # OpenCV 4.6 has setLogLevel at the top
    log = getattr(cv2.utils, "logging", cv2)
    level = log.setLogLevel(0)
    try:
        return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        return None
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
    order = {b"II*\0": "<", b"MM\0*": ">"}.get(data[:4])
    if order is None:
        return None
    (at,) = struct.unpack_from(order + "I", data, 4)
    (count,) = struct.unpack_from(order + "H", data, at)
    # one sample of one bit, unless the file says more
    values = {BITS: 1, SAMPLES: 1}
    for k in range(count):
        tag, kind, n = struct.unpack_from(order + "HHI", data, at + 2 + 12 * k)
        if tag not in (WIDTH, HEIGHT, BITS, SAMPLES):
            continue
        # these are SHORT or LONG, in place; only the bits, one value for each of three samples or more, lie elsewhere
        place = at + 10 + 12 * k
        if kind == 3 and n > 2:
            (place,) = struct.unpack_from(order + "I", data, place)
        (values[tag],) = struct.unpack_from(order + ("H" if kind == 3 else "I"), data, place)
    if not {WIDTH, HEIGHT} <= values.keys():
        return None
    return values[WIDTH], values[HEIGHT], values[SAMPLES] * max(values[BITS], 8) / 8


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

# SPDX-License-Identifier: Apache-2.0
"""Read frames from the bytes of cameras' raw files, through rawpy (LibRaw)."""

import io
import struct

import numpy as np

from starpos.errors import FrameError, one_line
from starpos.frames import exif
from starpos.frames.files import check_pixels
from starpos.frames.frame import PATTERNS, Frame, to_unsigned

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
    about = exif.told(data, place, clock, pixels.shape)
    # the sensor's own pixels are all here, whatever shape the camera gave to its pictures
    return Frame(to_unsigned(pixels, place), pattern=pattern, source=place, **about | {"origin_px": None})


def _words(error: Exception) -> str:
    """Message of an exception; LibRaw's messages are bytes."""
    told = error.args[0] if error.args else ""
    return one_line(told.decode("ascii", "replace") if isinstance(told, bytes) else error)


def _end(data: bytes) -> int:
    """Offset of the end of the last strip or tile in a file built like TIFF (CR2, DNG, NEF ...); 0 for other files."""
    order = {b"II": "<", b"MM": ">"}.get(data[:2])
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
            tags, following = _ifd(data, at, order)
        except struct.error:
            continue
        waiting += [following, *tags.get(BELOW, ())]
        for offsets, lengths in (STRIPS, TILES):
            parts = zip(tags.get(offsets, ()), tags.get(lengths, ()), strict=False)
            end = max([end, *(sum(part) for part in parts)])
    return end


def _ifd(data: bytes, at: int, order: str) -> tuple[dict[int, tuple[int, ...]], int]:
    """Values of the tags above in an IFD, and the offset of the next IFD; struct.error if it is not an IFD."""
    (count,) = struct.unpack_from(order + "H", data, at)
    tags = {}
    for k in range(count):
        entry = at + 2 + 12 * k
        tag, kind, n = struct.unpack_from(order + "HHI", data, entry)
        letter = {3: "H", 4: "I", 13: "I"}.get(kind)
        if tag in (*STRIPS, *TILES, BELOW) and letter and n <= MAX_VALUES:
            form = f"{order}{n}{letter}"
            place = entry + 8
            if struct.calcsize(form) > 4:
                (place,) = struct.unpack_from(order + "I", data, place)
            tags[tag] = struct.unpack_from(form, data, place)
    (following,) = struct.unpack_from(order + "I", data, at + 2 + 12 * count)
    return tags, following

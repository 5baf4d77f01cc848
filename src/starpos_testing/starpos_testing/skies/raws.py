# SPDX-License-Identifier: Apache-2.0
"""Camera files for the tests: DNG (TIFF 6.0's structure with a colour mosaic, Adobe DNG 1.4), and EXIF 2.31 in JPEG.

rawpy reads such files and writes none, so this writes the least of one that LibRaw takes for a camera's.
"""

import struct

import numpy as np

BYTE, ASCII, SHORT, LONG, RATIONAL, SRATIONAL = 1, 2, 3, 4, 5, 10
SIZES = {BYTE: 1, ASCII: 1, SHORT: 2, LONG: 4, RATIONAL: 8, SRATIONAL: 8}
COLOURS = {"r": 0, "g": 1, "b": 2}
EXIF, GPS, STRIPS = 0x8769, 0x8825, 0x111
START = "2026:11:02 18:00:00"


def exif_tags(
    start=START,
    subsec=None,
    offset=None,
    exposure=(1, 2),
    film_mm=None,
    focal=None,
    plane=None,
    unit=None,
    size=None,
    gps=None,
    lens=None,
    note=None,
):
    """The tags of an Exif IFD, with the GPS IFD's under 0x8825; None leaves one out.

    gps: UTC by GPS, a day like '2026:11:02' and whole hours, minutes and seconds.
    film_mm, focal (ratio of mm), plane (ratio of px per unit), unit, size (px) are of the focal length; lens: its name.
    note: bytes of the maker's note.
    """
    tags = {
        0x927C: None if note is None else (BYTE, note),
        0xA434: None if lens is None else (ASCII, lens),
        0x920A: None if focal is None else (RATIONAL, focal),
        0xA002: None if size is None else (LONG, [size[0]]),
        0xA003: None if size is None else (LONG, [size[1]]),
        0xA20E: None if plane is None else (RATIONAL, plane),
        0xA210: None if unit is None else (SHORT, [unit]),
        0xA405: None if film_mm is None else (SHORT, [film_mm]),
        0x829A: None if exposure is None else (RATIONAL, exposure),
        0x9003: None if start is None else (ASCII, start),
        0x9291: None if subsec is None else (ASCII, subsec),
        0x9011: None if offset is None else (ASCII, offset),
        GPS: None
        if gps is None
        else {0x1D: (ASCII, gps[0]), 0x07: (RATIONAL, [n for v in gps[1] for n in (v, 1)])},
    }
    return {tag: value for tag, value in tags.items() if value is not None}


def tiff(tags, exif, order="<", pixels=b""):
    """The bytes of a TIFF: an IFD of `tags` (with StripOffsets for `pixels`), an Exif and a GPS IFD, the pixels last."""
    exif, first = dict(exif), 8
    gps = exif.pop(GPS, None)
    below = [EXIF, *([GPS] if gps else []), *([STRIPS] if pixels else [])]
    at_exif = first + _length(tags | {tag: (LONG, [0]) for tag in below})
    at_gps = at_exif + _length(exif)
    at = {EXIF: at_exif, GPS: at_gps, STRIPS: at_gps + (_length(gps) if gps else 0)}
    tags = tags | {tag: (LONG, [at[tag]]) for tag in below}
    magic = (b"II*\0" if order == "<" else b"MM\0*") + struct.pack(order + "I", first)
    directories = (
        _ifd(tags, first, order) + _ifd(exif, at_exif, order) + (_ifd(gps, at_gps, order) if gps else b"")
    )
    return magic + directories + pixels


def dng(mosaic, pattern="rggb", order="<", **exif):
    """The bytes of a DNG of a (h, w) uint16 mosaic; the keywords are as for `exif_tags`."""
    height, width = mosaic.shape
    pixels = mosaic.astype(order + "u2").tobytes()
    tags = {
        0xFE: (LONG, [0]),
        0x100: (LONG, [width]),
        0x101: (LONG, [height]),
        0x102: (SHORT, [16]),
        # Not compressed.
        0x103: (SHORT, [1]),
        # A colour mosaic.
        0x106: (SHORT, [32803]),
        0x10F: (ASCII, "starpos"),
        0x110: (ASCII, "test"),
        0x112: (SHORT, [1]),
        0x115: (SHORT, [1]),
        0x116: (LONG, [height]),
        0x117: (LONG, [len(pixels)]),
        0x828D: (SHORT, [2, 2]),
        0x828E: (BYTE, [COLOURS[c] for c in pattern]),
        0xC612: (BYTE, [1, 4, 0, 0]),
        0xC614: (ASCII, "starpos test"),
        # Colours are XYZ.
        0xC621: (SRATIONAL, [1, 1, 0, 1, 0, 1, 0, 1, 1, 1, 0, 1, 0, 1, 0, 1, 1, 1]),
    }
    return tiff(tags, exif_tags(**exif), order, pixels)


def with_exif(jpeg, orientation=1, **exif):
    """The bytes of a JPEG with an APP1 segment of EXIF after its SOI."""
    segment = b"Exif\0\0" + tiff({0x112: (SHORT, [orientation])}, exif_tags(**exif))
    return jpeg[:2] + b"\xff\xe1" + struct.pack(">H", len(segment) + 2) + segment + jpeg[2:]


def mosaic(height=96, width=128, seed=1):
    """Noise (h, w) as uint16, brighter towards the bottom right."""
    rng = np.random.default_rng(seed)
    ramp = np.add.outer(np.arange(height) * 20, np.arange(width) * 3)
    return (ramp + rng.integers(500, 600, (height, width))).astype(np.uint16)


def _length(tags):
    values = sum(len(_bytes(*v, "<")) + 1 & ~1 for v in tags.values() if len(_bytes(*v, "<")) > 4)
    return 2 + 12 * len(tags) + 4 + values


def _ifd(tags, at, order):
    """The bytes of an IFD at a place of the file, followed by its long values."""
    entries, values = b"", b""
    behind = at + 2 + 12 * len(tags) + 4
    for tag, (kind, items) in sorted(tags.items()):
        data = _bytes(kind, items, order)
        entries += struct.pack(order + "HHI", tag, kind, len(data) // SIZES[kind])
        if len(data) > 4:
            entries += struct.pack(order + "I", behind + len(values))
            values += data + b"\0" * (len(data) % 2)
        else:
            entries += data.ljust(4, b"\0")
    return struct.pack(order + "H", len(tags)) + entries + b"\0\0\0\0" + values


def _bytes(kind, items, order):
    if kind == ASCII:
        return items.encode() + b"\0"
    letter = {BYTE: "B", SHORT: "H", LONG: "I", RATIONAL: "I", SRATIONAL: "i"}[kind]
    return struct.pack(f"{order}{len(items)}{letter}", *items)

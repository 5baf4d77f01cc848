# SPDX-License-Identifier: Apache-2.0
"""Directories of TIFF 6.0 and of what is built like it: EXIF, raw files, the notes of cameras' makers, GeoTIFF."""

import struct

PNG_START = b"\x89PNG\r\n\x1a\n"
JPEG_START = b"\xff\xd8\xff"
# Byte orders of a TIFF by its beginning, and of what is built like it.
TIFF_ORDERS = {b"II*\0": "<", b"MM\0*": ">"}
ORDERS = {b"II": "<", b"MM": ">"}
# Letters of struct by type of a tag: BYTE, ASCII, SHORT, SBYTE, UNDEFINED, SSHORT, SLONG, DOUBLE, and the two numbers of
# RATIONAL and SRATIONAL; of all others, LONG.
TIFF_KINDS = {1: "B", 2: "B", 3: "H", 5: "II", 6: "b", 7: "B", 8: "h", 9: "i", 10: "ii", 12: "d"}
EXIF_START = b"Exif\0\0"


def tiff_directory(
    data: bytes, at: int, order: str, wanted: tuple[int, ...], most: int
) -> tuple[dict[int, tuple], int]:
    """The first values, at most `most`, of the wanted tags of a TIFF's directory, and the offset of the next directory.

    struct.error if it is not a directory.  A text is its bytes, a rational two numbers.
    """
    (count,) = struct.unpack_from(order + "H", data, at)
    tags = {}
    for entry in range(at + 2, at + 2 + 12 * count, 12):
        tag, kind, n = struct.unpack_from(order + "HHI", data, entry)
        if tag not in wanted or not n:
            continue
        letters, place = TIFF_KINDS.get(kind, "I"), entry + 8
        if n * struct.calcsize(order + letters) > 4:
            (place,) = struct.unpack_from(order + "I", data, place)
        number = min(n, most) * len(letters)
        tags[tag] = struct.unpack_from(f"{order}{number}{letters[0]}", data, place)
    (following,) = struct.unpack_from(order + "I", data, at + 2 + 12 * count)
    return tags, following


def exif_block(data: bytes) -> bytes:
    """The TIFF that holds the EXIF of a JPEG, a PNG or a file built like TIFF; b"" without one."""
    if data[:2] in ORDERS:
        return data
    at = 2
    while data.startswith(JPEG_START) and data[at : at + 1] == b"\xff" and at + 4 <= len(data):
        end = at + 2 + int.from_bytes(data[at + 2 : at + 4], "big")
        if data[at + 4 : at + 10] == EXIF_START:
            return data[at + 10 : end]
        at = end
    at = len(PNG_START)
    while data.startswith(PNG_START) and at + 8 <= len(data):
        length, name, head = int.from_bytes(data[at : at + 4], "big"), data[at + 4 : at + 8], at + 8
        if name == b"eXIf":
            return data[head : head + length]
        at = head + length + 4
    return b""

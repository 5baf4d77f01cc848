# SPDX-License-Identifier: Apache-2.0
"""Which way is up in a telephone's photograph: the gravity that an iPhone writes into its maker's note of EXIF.

The note is a directory as TIFF has them, whose tag 8 is gravity in g; ExifTool's public tables state it.
"""

import math
import re
import struct
from dataclasses import dataclass

import numpy as np

from starpos.errors import FrameError
from starpos.frames.tiff import exif_block, tiff_directory

# name of the inclinometer (instrument/sensors.py)
PHONE = "phone"
MAKE, MODEL, ORIENTATION, SOFTWARE, BELOW, NOTE, LENS, RENDERED = (
    271,
    272,
    274,
    305,
    34665,
    37500,
    42036,
    41985,
)
TELEPHONES = re.compile(r"apple|google|samsung|xiaomi|huawei|oneplus|motorola|oppo|vivo", re.IGNORECASE)
# Length of gravity, g, of a telephone that is held still.
MIN_G, MAX_G = 0.97, 1.03
# Programs that crop, turn or bend pictures and keep the maker's note.
EDITOR = re.compile(
    r"photoshop|lightroom|gimp|snapseed|capture one|darktable|rawtherapee|picasa|imagemagick|affinity|luminar|hugin|ptgui"
    r"|pixelmator|vsco|photos \d|picsart|\bon1\b|dxo",
    re.IGNORECASE,
)
# CustomRendered of a panorama by Apple.
PANORAMA = 6
# Sides of any single exposure: beyond this it is stitched.
LONGEST_SHAPE = 2.4
# A telephone's pictures have sides that this divides; cut-outs have any.
WHOLE = 4
# Direction in C of the edge of the picture that was up, by EXIF's Orientation. Beyond this share of gravity along the
# picture the two have to agree.
EDGES = {1: (0, -1), 3: (0, 1), 6: (-1, 0), 8: (1, 0)}
CLEAR = 0.5
MOST_VALUES = 1 << 20
# The note's beginning, where its byte order stands, where its directory begins, and the tag of gravity.
APPLE, ORDER_AT, DIRECTORY_AT, GRAVITY = b"Apple iOS\0", 12, 14, 8
ORDERS = {b"II": "<", b"MM": ">"}


@dataclass(frozen=True, eq=False)
class Gravity:
    """Up in a picture by its own file: a unit vector (3,) in C, and make and model of the camera that it is in."""

    up: np.ndarray
    camera: str = ""


def _felt(note: bytes) -> np.ndarray | None:
    """Up (3,) by an iPhone's note; None if the note is another one.

    The telephone's axes are right, up the screen and out of it; columns of the picture are along -y, rows along -x.
    """
    if not note.startswith(APPLE):
        return None
    order = ORDERS[note[ORDER_AT : ORDER_AT + 2]]
    numbers = tiff_directory(note, DIRECTORY_AT, order, (GRAVITY,), MOST_VALUES)[0].get(GRAVITY)
    if numbers is None:
        return None
    if len(numbers) != 6 or 0 in numbers[1::2]:
        raise FrameError("the gravity in its maker's note is damaged")
    x, y, z = (a / b for a, b in zip(numbers[::2], numbers[1::2], strict=True))
    length = math.sqrt(x * x + y * y + z * z)
    if not MIN_G <= length <= MAX_G:
        raise FrameError(f"its telephone felt {length:.2f} g, so it was not held still")
    return np.array([y, x, z]) / length


@dataclass(frozen=True)
class _Facts:
    """What the EXIF of a file has: the tags of its first directory, and of the one below."""

    first: dict
    tags: dict

    @classmethod
    def of(cls, data: bytes) -> "_Facts":
        block = exif_block(data)
        order = ORDERS.get(block[:2], "<")
        try:
            (at,) = struct.unpack_from(order + "I", block, 4)
            first, _ = tiff_directory(block, at, order, (MAKE, MODEL, ORIENTATION, SOFTWARE, BELOW), 256)
            tags, _ = tiff_directory(block, first[BELOW][0], order, (NOTE, LENS, RENDERED), MOST_VALUES)
        except (struct.error, LookupError, TypeError):
            first, tags = {}, {}
        return cls(first, tags)

    def check_unedited(self) -> None:
        """Raise FrameError for the work of a program that may have moved the pixels."""
        software = _text(self.first.get(SOFTWARE))
        if EDITOR.search(software):
            raise FrameError(f"it was edited by {software}, so its pixels may not lie as its level says")

    def check_grid(self, width: int, height: int) -> None:
        """Raise FrameError unless the pixels lie as the back camera's sensor gave them."""
        if self.tags.get(RENDERED) == (PANORAMA,) or max(width, height) > LONGEST_SHAPE * min(width, height):
            raise FrameError("it is a panorama, stitched of several exposures")
        if "front" in _text(self.tags.get(LENS)):
            raise FrameError("it is by the telephone's front camera, whose level is not known")
        if height > width or width % WHOLE or height % WHOLE:
            raise FrameError(
                "its pixels were turned or cut out by a program, and the gravity in its file was not"
            )

    @property
    def upper_edge(self) -> tuple[int, int]:
        """Direction in C of the edge of the picture that was up, by its Orientation; 0, 0 if it is not stated."""
        return EDGES.get(self.first.get(ORIENTATION, (0,))[0], (0, 0))


def read_upper_edge(data: bytes, width: int, height: int) -> tuple[int, int] | None:
    """Which edge was up, as `upper_edge`, in a telephone's picture of width x height px, in the sensor's grid.

    None for other cameras, and for pictures whose pixels were moved.
    """
    facts = _Facts.of(data)
    if not TELEPHONES.match(_text(facts.first.get(MAKE))):
        return None
    try:
        facts.check_unedited()
        facts.check_grid(width, height)
    except FrameError:
        return None
    return facts.upper_edge


def contradicts(edge: tuple[int, int], up: np.ndarray) -> bool:
    """Whether the edge that is said to be up was down, by up (3,) in C."""
    return bool(np.hypot(*up[:2]) > CLEAR and np.dot(edge, up[:2]) < 0)


def read_gravity(data: bytes, width: int, height: int) -> Gravity:
    """Read which way is up in a picture of width x height px; FrameError says why its file does not say so.

    data: of a JPEG, PNG or TIFF-like file, or the EXIF of a HEIF alone.
    """
    facts = _Facts.of(data)
    facts.check_unedited()
    try:
        up = _felt(bytes(facts.tags.get(NOTE, ())))
    except (struct.error, TypeError, ValueError, LookupError):
        raise FrameError("its maker's note is damaged or cut off") from None
    if up is None:
        raise FrameError("its file does not say which way is down")
    facts.check_grid(width, height)
    if contradicts(facts.upper_edge, up):
        raise FrameError("its Orientation contradicts its level: a program turned it")
    return Gravity(up, " ".join(_text(facts.first.get(tag)) for tag in (MAKE, MODEL)).strip())


def _text(value: tuple | None) -> str:
    """The text of a tag; empty where it is missing or of another type."""
    if value is None or not all(isinstance(x, int) and 0 <= x < 256 for x in value):
        return ""
    return bytes(value).decode("ascii", "replace").strip("\0 ")

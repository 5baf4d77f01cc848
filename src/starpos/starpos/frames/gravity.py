# SPDX-License-Identifier: Apache-2.0
"""Which way is up in a telephone's photograph: the gravity that an iPhone writes into its maker's note of EXIF.

The note is a directory as TIFF has them, whose tag 8 is gravity in g; ExifTool's public tables state it.
"""

import math
import struct
from dataclasses import dataclass

import numpy as np

from starpos.errors import FrameError
from starpos.frames.tiff import tiff_directory

# name of the inclinometer (instrument/sensors.py)
PHONE = "phone"
# Length of gravity, g, of a telephone that is held still.
MIN_G, MAX_G = 0.97, 1.03
# Share of gravity along the picture beyond which it shows which edge was up.
CLEAR = 0.5
# The note's beginning, most of its bytes, where its byte order stands, where its directory begins, the tag of gravity.
APPLE, NOTE_BYTES, ORDER_AT, DIRECTORY_AT, GRAVITY = b"Apple iOS\0", 1 << 16, 12, 14, 8
ORDERS = {b"II": "<", b"MM": ">"}


@dataclass(frozen=True, eq=False)
class Gravity:
    """Up in a picture by its own file: a unit vector (3,) in C, and make and model of the camera that it is in."""

    up: np.ndarray
    camera: str = ""


def felt_up(data: bytes) -> np.ndarray:
    """Up (3,) in C by the note in the bytes of a picture, or in its EXIF alone; FrameError says why it does not say so.

    The telephone's axes are right, up the screen and out of it; columns of the picture are along -y, rows along -x.
    """
    at = data.find(APPLE)
    note = data[at : at + NOTE_BYTES] if at >= 0 else b""
    try:
        order = ORDERS[note[ORDER_AT : ORDER_AT + 2]] if note else "<"
        numbers = tiff_directory(note, DIRECTORY_AT, order, (GRAVITY,), 3)[0].get(GRAVITY) if note else None
    except (struct.error, LookupError):
        raise FrameError("its maker's note is damaged or cut off") from None
    if numbers is None:
        raise FrameError("its file does not say which way is down")
    if len(numbers) != 6 or 0 in numbers[1::2]:
        raise FrameError("the gravity in its maker's note is damaged")
    x, y, z = (a / b for a, b in zip(numbers[::2], numbers[1::2], strict=True))
    length = math.sqrt(x * x + y * y + z * z)
    if not MIN_G <= length <= MAX_G:
        raise FrameError(f"its telephone felt {length:.2f} g, so it was not held still")
    return np.array([y, x, z]) / length


def contradicts(edge: tuple[int, int], up: np.ndarray) -> bool:
    """Whether the edge that is said to be up was down, by up (3,) in C."""
    return bool(np.hypot(*up[:2]) > CLEAR and np.dot(edge, up[:2]) < 0)

# SPDX-License-Identifier: Apache-2.0
"""Which way is up in a picture, as the camera wrote it into its file: a telephone's accelerometer, a camera's level.

The maker's note of EXIF has it, a directory as TIFF has them. Apple's tag 8 is gravity in g; Panasonic, Olympus, Pentax,
Canon and Nikon write roll and pitch, and DJI the angles of its gimbal, in XMP. ExifTool's public tables state their
tags, steps and signs; LibRaw agrees about Nikon's.
"""

import math
import re
import struct
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from starpos.errors import FrameError
from starpos.frames.tiff import ORDERS, exif_block, tiff_directory
from starpos.tables import packaged

# names of inclinometers (instrument/sensors.py)
PHONE, CAMERA_LEVEL = "phone", "camera_level"
# tags of the first directory, and of the one below
MAKE, MODEL, ORIENTATION, SOFTWARE, BELOW = 271, 272, 274, 305, 34665
NOTE, LENS, RENDERED = 37500, 42036, 41985
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
GIMBAL = re.compile(rb"drone-dji:Gimbal(Pitch|Roll)Degree(?:=\"|>)\s*([-+]?\d+(?:\.\d+)?)")
# XMP stands before the picture in a JPEG.
XMP_BYTES = 1 << 18
MOST_VALUES = 1 << 20


@dataclass(frozen=True, eq=False)
class Gravity:
    """Up in a picture by its own file.

    up          (3,): unit vector in C
    stddev_rad  of it about each axis by the way it is written: its step, and what its frame leaves open
    model       of the inclinometer that felt it, by its name in sensors.csv
    camera      make and model of the camera that it is in
    """

    up: np.ndarray
    stddev_rad: float = 0.0
    model: str = PHONE
    camera: str = ""

    @classmethod
    def of_level(cls, roll_deg: float, pitch_deg: float, step_deg: float) -> "Gravity":
        """From the camera's clockwise roll and its upward pitch, which are rounded to a step; FrameError if impossible.

        No maker says whether roll is counted about the optical axis or is the lean of the camera's side: the difference
        is in the error.
        """
        if abs(roll_deg) > 180 or abs(pitch_deg) > 90:
            raise FrameError(f"its level's roll {roll_deg:g} and pitch {pitch_deg:g} deg are impossible")
        roll, pitch = math.radians(roll_deg), math.radians(pitch_deg)
        across = math.cos(pitch)
        up = np.array([-math.sin(roll) * across, -math.cos(roll) * across, math.sin(pitch)])
        step, open_ = math.radians(step_deg) / math.sqrt(12), math.sin(roll) * (1 - across) / math.sqrt(3)
        return cls(up, math.hypot(step, open_), CAMERA_LEVEL)


@dataclass(frozen=True)
class _Note:
    """A maker's note: bytes from which its offsets count, its byte order, and where its directory begins."""

    data: bytes
    order: str
    at: int

    def tags(self, *wanted: int) -> dict[int, tuple]:
        """The values of tags; struct.error if the note is cut off."""
        return tiff_directory(self.data, self.at, self.order, wanted, MOST_VALUES)[0]

    def below(self, tag: int) -> "_Note | None":
        """The directory that a tag holds, or points at."""
        held = self.tags(tag).get(tag)
        if held is None:
            return None
        return _Note(self.data, self.order, held[0] if len(held) == 1 else self.data.find(bytes(held)))


def _level(roll_deg: float, pitch_deg: float, step_deg: float) -> Gravity | None:
    """The level in a note; None for two zeros, which cameras without one write."""
    return Gravity.of_level(roll_deg, pitch_deg, step_deg) if roll_deg or pitch_deg else None


def _signed(value: int, range_: int) -> int:
    """A number that counts from 0 to a range, from minus half of it instead."""
    return (value + range_ // 2) % range_ - range_ // 2


def _apple(note: _Note) -> Gravity | None:
    """Gravity of an iPhone, right, up the screen and out of it; columns of the picture are along -y, rows along -x."""
    numbers = note.tags(8).get(8)
    if numbers is None:
        return None
    if len(numbers) != 6 or 0 in numbers[1::2]:
        raise FrameError("the gravity in its maker's note is damaged")
    x, y, z = (a / b for a, b in zip(numbers[::2], numbers[1::2], strict=True))
    length = math.sqrt(x * x + y * y + z * z)
    if not MIN_G <= length <= MAX_G:
        raise FrameError(f"its telephone felt {length:.2f} g, so it was not held still")
    return Gravity(np.array([y, x, z]) / length)


def _panasonic(note: _Note) -> Gravity | None:
    tags = note.tags(0x90, 0x91)
    if len(tags) < 2:
        return None
    return _level(_signed(tags[0x90][0], 1 << 16) / 10, -_signed(tags[0x91][0], 1 << 16) / 10, 0.1)


def _olympus(note: _Note) -> Gravity | None:
    below = note.below(0x2040)
    tags = {} if below is None else below.tags(0x903, 0x904)
    # the second number is 1 where the level is on
    if len(tags) < 2 or any(value[1:] != (1,) for value in tags.values()):
        return None
    return Gravity.of_level(-tags[0x903][0] / 10, tags[0x904][0] / 10, 0.1)


def _pentax(note: _Note) -> Gravity | None:
    level = note.tags(0x22B).get(0x22B, ())
    # the low bits: 1 and 9 of a camera held level or nearly so, for which alone the frame of the angles is known
    if len(level) < 3 or level[0] & 15 not in (1, 9):
        return None
    roll, pitch = (_signed(value, 256) for value in level[1:3])
    return _level(-roll / 2, -pitch / 2, 0.5)


def _canon(note: _Note) -> Gravity | None:
    level = note.tags(0x4059).get(0x4059)
    if level is None:
        return None
    # the first number is the length in bytes: a program that moves a note leaves its offsets
    if len(level) < 6 or level[0] & 0xFFFF != 4 * len(level):
        raise ValueError("not a level")
    roll, pitch = (_signed(value, 3600) for value in level[4:6])
    return _level(-roll / 10, pitch / 10, 0.1)


# ShutterMode of pictures that are taken of a film
FILMED = 96
# of a serial number
MOST_DIGITS = 20


@cache
def _nikons_tables() -> dict[str, bytes]:
    return {row["name"]: bytes.fromhex(row["value"]) for row in packaged("starpos.frames", "nikon.csv")}


def _nikon(note: _Note) -> Gravity | None:
    # offsets count from the byte order
    tags = _Note(note.data[10:], note.order, note.at - 10).tags(0x1D, 0x34, 0x91, 0xA7)
    if not {0x1D, 0x91, 0xA7} <= tags.keys() or tags.get(0x34) == (FILMED,):
        return None
    block, serial = bytes(tags[0x91]), _text(tags[0x1D])
    facts = _nikons_tables()
    level = facts.get(block[:4].decode("ascii", "replace"))
    if level is None:
        raise FrameError("it is by a Nikon whose level no public table describes")
    step = facts["by_serial"][int(serial[:MOST_DIGITS]) & 255]
    # the releases of its shutter are the second part of the key
    sum_ = facts["by_releases"][np.bitwise_xor.reduce(list(struct.pack("<I", tags[0xA7][0])))]
    n = np.arange(len(block) - 4, dtype=np.uint32) + 0x60
    mask = (sum_ + step * np.cumsum(n, dtype=np.uint64)).astype(np.uint8)
    plain = block[:4] + (np.frombuffer(block, np.uint8)[4:] ^ mask).tobytes()
    # the version of its firmware
    if not re.match(rb"\d[\d.]", plain[4:]):
        raise ValueError("another serial number or number of releases")
    (at,) = struct.unpack_from("<I", plain, level[0])
    roll, pitch = (_signed(value, 360 << 16) / (1 << 16) for value in struct.unpack_from("<2I", plain, at))
    if abs(roll) > 45:
        raise FrameError(
            "its camera was held upright or upside down, where no table says how a Nikon's angles count"
        )
    return _level(roll, pitch, 0.0)


# What a note begins with; where its byte order stands, None: EXIF's order; where its directory begins; whether offsets
# count from its own beginning, not from EXIF's; and what reads it.
NOTES: tuple[tuple[bytes, int | None, int, bool, Callable[[_Note], Gravity | None]], ...] = (
    (b"Apple iOS\0", 12, 14, True, _apple),
    (b"OLYMPUS\0", 8, 12, True, _olympus),
    (b"OM SYSTEM\0", 12, 16, True, _olympus),
    (b"PENTAX \0", 8, 10, True, _pentax),
    (b"Nikon\0\2", 10, 18, True, _nikon),
    (b"Panasonic\0", None, 12, False, _panasonic),
)


@dataclass(frozen=True)
class _Facts:
    """What the EXIF of a file has: its block, byte order, the tags of its first directory, and of the one below."""

    block: bytes
    order: str
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
        return cls(block, order, first, tags)

    def check_unedited(self) -> None:
        """Raise FrameError for the work of a program that may have moved the pixels."""
        software = _text(self.first.get(SOFTWARE))
        if EDITOR.search(software):
            raise FrameError(f"it was edited by {software}, so its pixels may not lie as its level says")

    def check_grid(self, width: int, height: int, by_phone: bool) -> None:
        """Raise FrameError unless the pixels lie as the back camera's sensor gave them."""
        if self.tags.get(RENDERED) == (PANORAMA,) or max(width, height) > LONGEST_SHAPE * min(width, height):
            raise FrameError("it is a panorama, stitched of several exposures")
        if "front" in _text(self.tags.get(LENS)):
            raise FrameError("it is by the telephone's front camera, whose level is not known")
        if by_phone and (height > width or width % WHOLE or height % WHOLE):
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
        facts.check_grid(width, height, by_phone=True)
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
        found = _by_gimbal(data) or _by_note(facts)
    except (struct.error, TypeError, ValueError, IndexError):
        raise FrameError("its maker's note is damaged or cut off") from None
    if found is None:
        raise FrameError("its file does not say which way is down")
    facts.check_grid(width, height, found.model == PHONE)
    if contradicts(facts.upper_edge, found.up):
        raise FrameError("its Orientation contradicts its level: a program turned it")
    return replace(found, camera=" ".join(_text(facts.first.get(tag)) for tag in (MAKE, MODEL)).strip())


def _text(value: tuple | None) -> str:
    """The text of a tag; empty where it is missing or of another type."""
    if value is None or not all(isinstance(x, int) and 0 <= x < 256 for x in value):
        return ""
    return bytes(value).decode("ascii", "replace").strip("\0 ")


def _by_gimbal(data: bytes) -> Gravity | None:
    angles = {name: float(value) for name, value in GIMBAL.findall(data[:XMP_BYTES])}
    return Gravity.of_level(angles[b"Roll"], angles[b"Pitch"], 0.1) if len(angles) == 2 else None


def _by_note(facts: _Facts) -> Gravity | None:
    block, order, note = facts.block, facts.order, bytes(facts.tags.get(NOTE, ()))
    for start, order_at, directory, own, read in NOTES:
        if note.startswith(start):
            if order_at is not None:
                order = ORDERS.get(note[order_at : order_at + 2], "")
            if not order:
                raise ValueError("no byte order")
            return read(
                _Note(note, order, directory) if own else _Note(block, order, block.find(note) + directory)
            )
    if note and _text(facts.first.get(MAKE)).startswith("Canon"):
        # a program that turns EXIF's byte order leaves the note's; a note has less than 256 tags
        return _canon(_Note(block, "<" if note[1] == 0 else ">", block.find(note)))
    return None

# SPDX-License-Identifier: Apache-2.0
"""Which way is up in a picture: makers' notes, made here byte by byte by the public tables of their tags."""

import struct

import numpy as np
import pytest

from starpos.errors import FrameError
from starpos.frames.gravity import read_gravity
from starpos.frames.reading import read_frame
from starpos_testing.lacking import needs
from starpos_testing.skies import raws

BYTES, SHORT, LONG, SIGNED, RATIONAL = 7, 3, 4, 8, 10


def directory(tags, order, at):
    """A directory of TIFF whose first byte stands at `at`: by tag its type, its number of values and their bytes."""
    entries, beyond = b"", b""
    after = at + 2 + 12 * len(tags) + 4
    for tag, (kind, count, value) in sorted(tags.items()):
        held = value.ljust(4, b"\0") if len(value) <= 4 else struct.pack(order + "I", after + len(beyond))
        beyond += value if len(value) > 4 else b""
        entries += struct.pack(order + "HHI", tag, kind, count) + held
    return struct.pack(order + "H", len(tags)) + entries + bytes(4) + beyond


def text(words):
    return 2, len(words) + 1, words.encode() + b"\0"


def exif(note, make="Apple", orientation=0, order="<", **more):
    """The EXIF of a picture; note: bytes, or a function of the place at which it will stand."""
    at = {"at": 0}
    for _ in range(2):
        made = note(at["at"]) if callable(note) else note
        below = {37500: (BYTES, len(made), made)} | more.get("below", {})
        first = {
            271: text(make),
            274: (SHORT, 1, struct.pack(order + "H", orientation)),
            34665: (LONG, 1, bytes(4)),
        }
        first |= {305: text(more["software"])} if "software" in more else {}
        start = 8 + len(directory(first, order, 8))
        first[34665] = LONG, 1, struct.pack(order + "I", start)
        whole = (b"II*\0" if order == "<" else b"MM\0*") + struct.pack(order + "I", 8)
        whole += directory(first, order, 8) + directory(below, order, start)
        at["at"] = whole.find(made)
    return whole


def apple(gravity, order=">", unit=1000000):
    head = b"Apple iOS\0\0\1" + (b"MM" if order == ">" else b"II")
    numbers = b"".join(struct.pack(order + "ii", round(x * unit), unit) for x in gravity)
    return head + directory({8: (RATIONAL, 3, numbers)}, order, len(head))


def up(data, width=4032, height=3024):
    return read_gravity(data, width, height).up


@pytest.mark.parametrize("order", "<>")
def test_an_iphones_gravity_in_the_axes_of_the_stored_picture(order):
    # screen down on a table: the camera looks up
    assert up(exif(apple((0, 0, 1.0), order), order=order)) == pytest.approx([0, 0, 1])
    # upright: the top of the screen is up, and so is the first column of the stored picture
    assert up(exif(apple((0, -1.0, 0), order))) == pytest.approx([-1, 0, 0])
    # on its left side, the right edge of the screen up: the first row
    assert up(exif(apple((-1.0, 0, 0), order))) == pytest.approx([0, -1, 0])


def test_the_cameras_own_program_is_no_editor():
    assert up(exif(apple((0, 0, 1.0)), software="Version1.02")) == pytest.approx([0, 0, 1])


def test_a_name_of_another_type_does_no_harm():
    assert up(exif(apple((0, 0, 1.0)), below={42036: (LONG, 1, struct.pack("<I", 300))})) == pytest.approx(
        [0, 0, 1]
    )


@needs("rawpy")
@needs("exifread")
@pytest.mark.parametrize("order", "<>")
def test_a_dng_has_it_as_the_telephone_wrote_it(tmp_path, order):
    (tmp_path / "IMG.DNG").write_bytes(raws.dng(raws.mosaic(), order=order, note=apple((-1.0, 0, 0))))
    assert read_frame(tmp_path / "IMG.DNG").gravity.up == pytest.approx([0, -1, 0])


def panasonic(roll, pitch):
    levels = {
        0x90: (SHORT, 1, struct.pack("<h", 10 * roll)),
        0x91: (SHORT, 1, struct.pack("<h", -10 * pitch)),
    }
    return lambda at: b"Panasonic\0\0\0" + directory(levels, "<", at + 12)


def olympus(roll, pitch, on=1):
    def below(at):
        levels = {
            0x903: (SIGNED, 2, struct.pack("<hh", -10 * roll, on)),
            0x904: (SIGNED, 2, struct.pack("<hh", 10 * pitch, on)),
        }
        return directory(levels, "<", at)

    head = b"OLYMPUS\0II\3\0"
    start = len(head) + 2 + 12 + 4
    return head + directory({0x2040: (13, 1, struct.pack("<I", start))}, "<", len(head)) + below(start)


def pentax(roll, pitch, position=9):
    level = struct.pack("bbb5x", position, -2 * roll, -2 * pitch)
    return b"PENTAX \0II" + directory({0x22B: (BYTES, 8, level)}, "<", 10)


def canon(roll, pitch):
    level = struct.pack("<7i", 28, 0, 0, 0, (-10 * roll) % 3600, (10 * pitch) % 3600, 0)
    return lambda at: directory({0x4059: (LONG, 7, level)}, "<", at)


def nikon(roll, pitch, version=b"0243", at=0xA0, serial="6001442", mode=0):
    """The cipher of a camera whose serial number ends with 34 (mod 256) and that was released 70000 times."""
    plain = bytearray(0x150)
    plain[:8] = version + b"1.20"
    struct.pack_into("<I", plain, at, 0x120)
    struct.pack_into("<3I", plain, 0x120, *(round((x % 360) * 65536) for x in (roll, pitch, 0)))
    # ExifTool's tables at 34, and at the exclusive or of the bytes of 70000, 0x60
    step, sum_ = 0xEF, 0x8B
    for n in range(len(plain) - 4):
        plain[4 + n] ^= (sum_ + step * sum(range(0x60, 0x61 + n))) & 255
    tags = {0x1D: text(serial), 0x34: (SHORT, 1, struct.pack("<H", mode))}
    tags |= {0x91: (BYTES, len(plain), bytes(plain)), 0xA7: (LONG, 1, struct.pack("<I", 70000))}
    return b"Nikon\0\2\x10\0\0II*\0\x08\0\0\0" + directory(tags, "<", 8)


MAKERS = [("Panasonic", panasonic), ("OLYMPUS CORPORATION", olympus), ("PENTAX", pentax), ("Canon", canon)]
MAKERS += [("NIKON CORPORATION", nikon)]


@pytest.mark.parametrize(("make", "note"), MAKERS)
def test_roll_and_pitch_of_cameras(make, note):
    gravity = read_gravity(exif(note(10, 40), make), 4000, 3000)
    # a camera that was turned clockwise sees up to the left of its picture's top
    r, p = np.radians([10, 40])
    assert gravity.up == pytest.approx([-np.sin(r) * np.cos(p), -np.cos(r) * np.cos(p), np.sin(p)])
    assert gravity.model == "camera_level" and np.degrees(gravity.stddev_rad) < 2


@pytest.mark.parametrize(
    ("version", "at"), [(b"0233", 0x84), (b"0803", 0x98), (b"0246", 0x9C), (b"0810", 0x88)]
)
def test_the_angles_of_nikons_stand_elsewhere_in_each_model(version, at):
    assert up(exif(nikon(0, 40, version, at), "NIKON")) == pytest.approx(
        [0, -np.cos(np.radians(40)), 0.643], abs=1e-3
    )


def test_canons_note_keeps_its_byte_order_where_a_program_has_turned_that_of_exif():
    assert up(exif(canon(0, 30), "Canon", order=">")) == pytest.approx([0, -np.sqrt(0.75), 0.5])


def test_a_canons_note_whose_offsets_lie_elsewhere_is_damaged():
    data = exif(canon(10, 40), "Canon").replace(struct.pack("<i", 28), struct.pack("<i", 3600))
    with pytest.raises(FrameError, match=DAMAGED):
        read_gravity(data, 4000, 3000)


def test_a_gimbals_angles_in_xmp():
    packet = b'\xff\xd8\xff\xe1<x drone-dji:GimbalRollDegree="+0.00" drone-dji:GimbalPitchDegree="+30.00"/>'
    assert up(packet) == pytest.approx([0, -np.sqrt(0.75), 0.5])


DAMAGED = "its maker's note is damaged or cut off"
SILENT = "its file does not say which way is down"


@pytest.mark.parametrize(
    ("data", "why"),
    [
        (b"", SILENT),
        (exif(b"no note of any maker known"), SILENT),
        (exif(olympus(0, 0, on=0), "OLYMPUS"), SILENT),
        (exif(pentax(0, 0, position=13), "PENTAX"), SILENT),
        # cameras without a level write zeros, as a DMC-LX7 does
        (exif(panasonic(0, 0), "Panasonic"), SILENT),
        (exif(nikon(1, 2, mode=96), "NIKON"), SILENT),
        (exif(nikon(1, 2, version=b"0231"), "NIKON"), "a Nikon whose level no public table describes"),
        (exif(nikon(-89, 2), "NIKON"), "held upright or upside down"),
        (exif(nikon(1, 2, serial="6001443"), "NIKON"), DAMAGED),
        (exif(nikon(1, 2, serial="no number"), "NIKON"), DAMAGED),
        (exif(nikon(1, 2)[:-0x40], "NIKON"), DAMAGED),
        (
            exif(nikon(1, 2).replace(struct.pack("<HII", LONG, 1, 70000), struct.pack("<HIi", 9, 1, -5))),
            DAMAGED,
        ),
        (exif(apple((0, 0, 1.0))[:-30]), DAMAGED),
        (exif(apple((0, 0, 1.0)))[:-8], SILENT),
        (exif(apple((0, 0, 1.0)).replace(b"\1MM", b"\1XX")), DAMAGED),
        (exif(apple((0, 0, 1.0), unit=0)), "the gravity in its maker's note is damaged"),
        (exif(apple((0, 0, 1.2))), "felt 1.20 g"),
        (exif(apple((0, -1.0, 0)), orientation=8), "Orientation contradicts"),
        (exif(panasonic(170, 10), "Panasonic", orientation=1), "Orientation contradicts"),
        (exif(panasonic(0, 95), "Panasonic"), "impossible"),
        (exif(apple((0, 0, 1.0)), software="Adobe Photoshop 25.1"), "edited by Adobe Photoshop 25.1"),
        (exif(apple((0, 0, 1.0)), below={41985: (SHORT, 1, b"\6\0")}), "panorama"),
        (
            exif(apple((0, 0, 1.0)), below={42036: text("iPhone 12 Pro front TrueDepth camera")}),
            "front camera",
        ),
    ],
)
def test_what_a_file_does_not_say_is_not_guessed(data, why):
    with pytest.raises(FrameError, match=why):
        read_gravity(data, 4032, 3024)


@pytest.mark.parametrize("size", [(3024, 4032), (3771, 2829)])
def test_a_picture_that_was_turned_or_cut_by_a_program_has_no_gravity(size):
    with pytest.raises(FrameError, match="turned or cut out by a program"):
        read_gravity(exif(apple((0, 0, 1.0))), *size)

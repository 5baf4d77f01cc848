# SPDX-License-Identifier: Apache-2.0
"""Which way is up in a telephone's picture: the maker's note, made here byte by byte by the public table of its tags."""

import struct

import pytest

from starpos.errors import FrameError
from starpos.frames.exif import Exif
from starpos.frames.reading import read_frame
from starpos_testing.lacking import needs
from starpos_testing.skies import raws

BYTES, SHORT, LONG, RATIONAL = 7, 3, 4, 10


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
    """The EXIF of a picture with a maker's note."""
    below = {37500: (BYTES, len(note), note)} | more.get("below", {})
    first = {
        271: text(make),
        274: (SHORT, 1, struct.pack(order + "H", orientation)),
        34665: (LONG, 1, bytes(4)),
    }
    first |= {305: text(more["software"])} if "software" in more else {}
    start = 8 + len(directory(first, order, 8))
    first[34665] = LONG, 1, struct.pack(order + "I", start)
    whole = (b"II*\0" if order == "<" else b"MM\0*") + struct.pack(order + "I", 8)
    return whole + directory(first, order, 8) + directory(below, order, start)


def apple(gravity, order=">", unit=1000000):
    head = b"Apple iOS\0\0\1" + (b"MM" if order == ">" else b"II")
    numbers = b"".join(struct.pack(order + "ii", round(x * unit), unit) for x in gravity)
    return head + directory({8: (RATIONAL, 3, numbers)}, order, len(head))


def read_gravity(data, width=4032, height=3024):
    return Exif.of(data, width, height).gravity(data)


def up(data):
    return read_gravity(data).up


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


DAMAGED = "its maker's note is damaged or cut off"
SILENT = "its file does not say which way is down"


@pytest.mark.parametrize(
    ("data", "why"),
    [
        (b"", SILENT),
        (exif(b"no note of any maker known"), SILENT),
        (exif(apple((0, 0, 1.0))[:-30]), DAMAGED),
        (exif(apple((0, 0, 1.0)))[:-8], DAMAGED),
        (exif(apple((0, 0, 1.0)).replace(b"\1MM", b"\1XX")), DAMAGED),
        (exif(apple((0, 0, 1.0), unit=0)), "the gravity in its maker's note is damaged"),
        (exif(apple((0, 0, 1.2))), "felt 1.20 g"),
        (exif(apple((0, -1.0, 0)), orientation=8), "Orientation contradicts"),
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
        read_gravity(data)


@pytest.mark.parametrize("size", [(3024, 4032), (3771, 2829)])
def test_a_picture_that_was_turned_or_cut_by_a_program_has_no_gravity(size):
    with pytest.raises(FrameError, match="turned or cut out by a program"):
        read_gravity(exif(apple((0, 0, 1.0))), *size)

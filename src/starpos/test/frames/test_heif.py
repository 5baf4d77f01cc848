# SPDX-License-Identifier: Apache-2.0
"""HEIF, as phones and newer cameras write it: whole ones are read, in 8 and 10 bits; others cost a sentence."""

import contextlib
import io
import sys

import numpy as np
import pytest

from starpos.errors import FrameError
from starpos.frames import reading
from starpos.frames.exif import CameraClock
from starpos.frames.frame import Frame
from starpos.frames.reading import read_frame
from starpos_testing.lacking import needs
from starpos_testing.skies import raws

needs_heif, needs_exifread = needs("pillow_heif"), needs("exifread")
GREY = (raws.mosaic(96, 128) >> 8).astype(np.uint8)


def heif(pixels, **about):
    """The bytes of a HEIF file of pixels (h, w) or (h, w, 3), 8 or 16 bits, without loss but for rounding."""
    import pillow_heif

    colour, deep = pixels.ndim == 3, pixels.dtype == np.uint16
    mode = ("BGR" if colour else "L") + (";16" if deep else "")
    file, size = io.BytesIO(), (pixels.shape[1], pixels.shape[0])
    pillow_heif.encode(mode, size, pixels.tobytes(), file, quality=-1, chroma=444, **about)
    return file.getvalue()


def write(path, data):
    path.write_bytes(data)
    return path


@needs_heif
@pytest.mark.parametrize("suffix", [".heic", ".HIF"])
def test_colours_of_8_bits_stay(tmp_path, suffix):
    colours = np.dstack([GREY, GREY // 2, GREY // 4])
    frame = read_frame(write(tmp_path / f"a{suffix}", heif(colours)))
    assert frame.pixels.dtype == np.uint8 and frame.pixels.shape == colours.shape
    assert np.abs(frame.pixels.astype(int) - colours).max() <= 3


@needs_heif
def test_colours_of_10_bits_become_grey_of_16(tmp_path):
    grey = np.repeat(np.arange(0, 65536, 512, dtype=np.uint16)[None], 64, 0)
    frame = read_frame(write(tmp_path / "a.heif", heif(np.dstack([grey] * 3))))
    assert frame.pixels.dtype == np.uint16 and frame.pixels.shape == grey.shape
    # 10 bits are steps of 64
    assert np.abs(frame.pixels.astype(int) - grey).max() <= 200


@needs_heif
@needs_exifread
def test_its_exif_tells_exposure_time_and_focal_length(tmp_path):
    exif = b"Exif\0\0" + raws.tiff({0x112: (raws.SHORT, [1])}, raws.exif_tags(film_mm=26, subsec="25"))
    frame = read_frame(
        write(tmp_path / "a.heic", heif(np.dstack([GREY] * 3), exif=exif)), CameraClock(0.0, 2.0)
    )
    assert frame.exposure_s == 0.5 and frame.clock_stddev_s == 2.0
    assert frame.rough_focal_px == pytest.approx(26 / 43.27 * np.hypot(128, 96), rel=1e-3)


@needs_heif
def test_what_breaks_off_or_is_damaged_is_one_sentence(tmp_path, rng):
    whole = heif(np.dstack([GREY] * 3))
    for end in (12, 100, len(whole) // 2, len(whole) - 10):
        with pytest.raises(FrameError, match="not a whole HEIF"):
            read_frame(write(tmp_path / "a.heic", whole[:end]))
    for content in (b"x" * 5000, b"\0\0\0\x18ftypheic" + bytes(300)):
        with pytest.raises(FrameError, match="not a whole HEIF"):
            read_frame(write(tmp_path / "a.heic", content))
    for _ in range(60):
        bad = bytearray(whole)
        for place in rng.integers(0, len(whole), rng.integers(1, 8)):
            bad[place] = rng.integers(256)
        with contextlib.suppress(FrameError):
            assert isinstance(read_frame(write(tmp_path / "a.heic", bad)), Frame)


@needs_heif
def test_a_header_that_claims_gigabytes_is_refused_before_any_is_taken(tmp_path, monkeypatch):
    whole = bytearray(heif(np.dstack([GREY] * 3)))
    at = whole.index(b"ispe") + 8
    whole[at : at + 8] = (30_000).to_bytes(4, "big") * 2
    with pytest.raises(FrameError, match=r"claims|not a whole HEIF"):
        read_frame(write(tmp_path / "a.heic", whole))
    monkeypatch.setattr(reading, "MAX_BYTES", 10_000)
    with pytest.raises(FrameError, match="too many for a frame"):
        read_frame(write(tmp_path / "a.heic", whole + bytes(10_000)))


def test_where_pillow_heif_is_missing_it_says_what_to_do(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pillow_heif", None)
    with pytest.raises(FrameError, match=r"pip install pillow-heif.*JPEG"):
        read_frame(write(tmp_path / "a.heic", b"\0\0\0\x18ftypheic"))

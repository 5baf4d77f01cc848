# SPDX-License-Identifier: Apache-2.0
"""Files that are damaged, that claim or unpack to too much, or that are no files: each costs its own frame."""

import gzip
import os
import struct
import zlib

import cv2
import numpy as np
import pytest
from astropy.io import fits

from starpos.errors import FrameError
from starpos.frames import fits as frames_fits
from starpos.frames import frame as frame_files
from starpos.frames import reading
from starpos.frames.frame import Frame
from starpos.frames.reading import read_frame

SKY = np.random.default_rng(7).normal(1000, 30, (60, 80)).astype(np.int16)


def refused(path):
    """The sentence by which a frame is refused."""
    with pytest.raises(FrameError) as raised:
        read_frame(path)
    text = str(raised.value)
    assert text.startswith(f"{path}") and "\n" not in text and len(text) < 600
    return text


def packed_fits(path, kind):
    """A FITS file that is compressed: 'GZIP' as a whole, else its tiles by this algorithm."""
    if kind == "GZIP":
        fits.PrimaryHDU(SKY).writeto(path, overwrite=True)
        return path
    hdu = fits.CompImageHDU(SKY, compression_type=kind, tile_shape=(20, 80))
    fits.HDUList([fits.PrimaryHDU(), hdu]).writeto(path, overwrite=True)
    return path


@pytest.mark.parametrize("kind", ["GZIP", "RICE_1", "GZIP_1", "GZIP_2"])
def test_whatever_is_damaged_of_a_compressed_frame_it_is_one_sentence(tmp_path, kind):
    rng = np.random.default_rng(5)
    path = packed_fits(tmp_path / ("a.fits.gz" if kind == "GZIP" else "a.fits.fz"), kind)
    whole = path.read_bytes()
    # the header's text is damaged by another test
    first = 10 if kind == "GZIP" else whole.index(b"END" + b" " * 77, 2880) + 80
    told = 0
    for place in rng.integers(first, len(whole), 60):
        bad = bytearray(whole)
        bad[place : place + 4] = rng.bytes(4)
        path.write_bytes(bad[: len(whole) if place % 3 else place])
        try:
            assert isinstance(read_frame(path), Frame)
        except FrameError as e:
            told += 1
            assert str(e).startswith(f"{path}: ")
    assert told > 10


@pytest.mark.parametrize("kind", ["HCOMPRESS_1", "PLIO_1"])
def test_what_astropy_may_crash_on_is_not_unpacked(tmp_path, kind):
    path = tmp_path / "a.fits.fz"
    hdu = fits.CompImageHDU(np.abs(SKY), compression_type=kind, tile_shape=(20, 80))
    fits.HDUList([fits.PrimaryHDU(), hdu]).writeto(path)
    assert f"packed by {kind}" in refused(path)


def test_a_pipe_in_place_of_a_frame_is_not_waited_for(tmp_path):
    for suffix in (".fits", ".fits.gz", ".png", ".tif", ".nef", ".csv"):
        path = tmp_path / f"a{suffix}"
        os.mkfifo(path)
        assert "no regular file" in refused(path)


def fits_header(width, height, bits):
    cards = {"BITPIX": bits, "NAXIS": 2, "NAXIS1": width, "NAXIS2": height}
    lines = ["SIMPLE  =                    T", *(f"{k:8}= {v:20}" for k, v in cards.items()), "END"]
    return "".join(line.ljust(80) for line in lines).ljust(2880).encode()


def png_header(width, height, bits, colour):
    head = b"IHDR" + struct.pack(">IIBBBBB", width, height, bits, colour, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + head + struct.pack(">I", zlib.crc32(head))


def tiff_header(width, height, bits, samples):
    """A TIFF's directory, whose bits are listed at its end."""
    entries = [
        (256, 4, 1, width),
        (257, 4, 1, height),
        (258, 3, samples, bits if samples == 1 else 62),
        (277, 3, 1, samples),
    ]
    rows = b"".join(struct.pack("<HHII", *entry) for entry in entries)
    return b"II*\0\x08\0\0\0" + struct.pack("<H", 4) + rows + bytes(4) + struct.pack("<H", bits) * 4


def jpeg_header(width, height, samples):
    frame = struct.pack(">HBHHB", 8 + 3 * samples, 8, height, width, samples) + bytes(3 * samples)
    return b"\xff\xd8\xff\xc0" + frame + b"\xff\xda\xff\xd9"


@pytest.mark.parametrize(
    ("name", "few", "many"),
    [
        ("a.fits", fits_header(20_000, 10_000, 16), fits_header(20_000, 10_000, -64)),
        ("a.png", png_header(20_000, 10_000, 16, 0), png_header(20_000, 10_000, 16, 6)),
        ("a.tif", tiff_header(20_000, 10_000, 16, 1), tiff_header(1000, 1000, 16, 1000)),
        ("a.tif", tiff_header(20_000, 10_000, 8, 3), tiff_header(20_000, 10_000, 16, 3)),
        ("a.jpg", jpeg_header(20_000, 20_000, 1), jpeg_header(20_000, 20_000, 3)),
    ],
    ids=["fits", "png", "samples of a tif", "bits of a tif", "jpg"],
)
def test_a_header_is_held_to_the_bytes_it_claims_not_to_pixels(tmp_path, name, few, many):
    """Half as many bytes a pixel, or pixels of fewer samples, may be read: what follows the header is missing here."""
    (tmp_path / name).write_bytes(few)
    assert "claims" not in refused(tmp_path / name)
    (tmp_path / name).write_bytes(many)
    assert "claims" in refused(tmp_path / name)


@pytest.fixture
def small_limit(monkeypatch):
    """A limit of 100 kB, of files and of what they unpack to."""
    for module in (frame_files, frames_fits, reading):
        monkeypatch.setattr(module, "MAX_BYTES", 100_000)


def test_what_a_gz_unpacks_to_is_limited(tmp_path, small_limit):
    path = tmp_path / "a.fits.gz"
    empty = np.zeros((100, 100), np.uint8)
    fits.PrimaryHDU(empty).writeto(tmp_path / "a.fits")
    content = (tmp_path / "a.fits").read_bytes()
    path.write_bytes(gzip.compress(content))
    assert np.array_equal(read_frame(path).pixels, empty)
    path.write_bytes(gzip.compress(content + bytes(100_000)))
    assert path.stat().st_size < 1000
    assert "unpacks to over" in refused(path)
    for unpacked in (gzip.compress(content), b"x" * 3000, b""):
        path.write_bytes(gzip.compress(unpacked))
        assert "SIMPLE" in refused(path)


@pytest.mark.parametrize("kind", ["GZIP_1", "GZIP_2"])
def test_what_the_tiles_of_a_fz_unpack_to_is_limited(tmp_path, small_limit, kind):
    path = packed_fits(tmp_path / "a.fits.fz", kind)
    assert read_frame(path).pixels.shape == SKY.shape
    whole = path.read_bytes()
    cell = whole.index(b"\x1f\x8b")
    bomb = gzip.compress(bytes(300_000), mtime=0)
    path.write_bytes(whole[:cell] + bomb + whole[cell + len(bomb) :])
    assert "unpacks to over" in refused(path)


def test_other_archives_in_the_name_of_fits_are_not_unpacked(tmp_path):
    import bz2
    import lzma

    fits.PrimaryHDU(SKY).writeto(tmp_path / "whole.fits")
    for pack in (bz2.compress, lzma.compress):
        (tmp_path / "a.fits").write_bytes(pack((tmp_path / "whole.fits").read_bytes()))
        assert "SIMPLE" in refused(tmp_path / "a.fits")


def test_a_file_larger_than_the_limit_is_not_read(tmp_path, small_limit):
    for name in ("a.fits", "a.png", "a.nef"):
        with (tmp_path / name).open("wb") as file:
            file.truncate(100_001)
        assert "too many for a frame" in refused(tmp_path / name)


def test_the_error_of_a_star_list_does_not_quote_the_whole_file(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text('# {"NAXIS1": 9, "NAXIS2": 9}\n' + ",".join(["name"] * 100_000))
    refused(path)


def test_an_image_after_two_hundred_empty_parts_is_not_looked_for(tmp_path):
    parts = [fits.PrimaryHDU(), *(fits.ImageHDU() for _ in range(200)), fits.ImageHDU(SKY)]
    fits.HDUList(parts).writeto(tmp_path / "a.fits")
    assert "no image" in refused(tmp_path / "a.fits")


def test_pictures_with_fewer_bits_or_alpha_are_read_as_before(tmp_path):
    grey = np.arange(64, dtype=np.uint8).reshape(8, 8)
    cv2.imwrite(str(tmp_path / "a.png"), np.dstack([grey] * 4))
    assert read_frame(tmp_path / "a.png").pixels.shape == (8, 8, 3)
    cv2.imwrite(str(tmp_path / "b.png"), grey, [cv2.IMWRITE_PNG_BILEVEL, 1])
    assert read_frame(tmp_path / "b.png").width == 8

# SPDX-License-Identifier: Apache-2.0
"""However a camera was held, every format gives the rows and columns of its sensor."""

import io
from importlib.util import find_spec

import cv2
import numpy as np
import pytest

from starpos.frames.pictures import heif_frame, picture_frame
from starpos_testing.lacking import needs
from starpos_testing.skies import raws

needs_heif = needs("pillow_heif")
ORIENTATIONS = range(1, 9)


def asymmetric():
    """A picture (48, 64) without any symmetry: a light of another brightness in three of its corners."""
    picture = np.zeros((48, 64), np.uint8)
    picture[4:12, 4:12], picture[4:12, 48:56], picture[36:44, 4:12] = 250, 170, 90
    return picture


def heic(picture, orientation):
    """The bytes of a HEIF file that a decoder turns, and whose EXIF says so, from which pillow-heif makes the boxes."""
    import pillow_heif

    exif = b"Exif\0\0" + raws.tiff({0x112: (raws.SHORT, [orientation])}, raws.exif_tags())
    file, size = io.BytesIO(), (picture.shape[1], picture.shape[0])
    pillow_heif.encode("L", size, picture.tobytes(), file, quality=-1, chroma=444, exif=exif)
    return file.getvalue()


@needs_heif
@pytest.mark.parametrize("orientation", ORIENTATIONS)
def test_a_heic_is_turned_back(orientation):
    picture = asymmetric()
    data = heic(picture, orientation)
    assert (b"irot" in data or b"imir" in data) == (orientation != 1)
    pixels = heif_frame(data, "a.heic").pixels
    assert pixels.shape[:2] == picture.shape
    assert np.abs(pixels.reshape(48, 64, -1).mean(2) - picture).max() <= 3


@needs_heif
def test_a_heic_whose_exif_alone_has_an_orientation_stays():
    """A decoder turns by the boxes only."""
    picture, tag = asymmetric(), b"\x12\x01\x03\0\x01\0\0\0"
    data = heic(picture, 1).replace(tag + b"\1", tag + b"\6")
    assert data != heic(picture, 1)
    pixels = heif_frame(data, "a.heic").pixels
    assert np.abs(pixels.reshape(48, 64, -1).mean(2) - picture).max() <= 3


@pytest.mark.parametrize("orientation", ORIENTATIONS)
def test_a_jpeg_stays(orientation):
    picture = asymmetric()
    plain = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 100])[1].tobytes()
    pixels = picture_frame(raws.with_exif(plain, orientation), "a.jpg").pixels
    assert np.array_equal(pixels, picture_frame(plain, "a.jpg").pixels)
    assert np.abs(pixels.astype(int) - picture).max() <= 3


@pytest.mark.parametrize("order", "<>")
@pytest.mark.parametrize("deep", [False, True])
@pytest.mark.parametrize("orientation", ORIENTATIONS)
def test_a_tiff_stays(orientation, deep, order):
    picture = asymmetric() * np.uint16(200) if deep else asymmetric()
    height, width = picture.shape
    pixels = picture.astype(order + picture.dtype.str[1:]).tobytes()
    tags = {0x100: width, 0x101: height, 0x102: 8 * picture.itemsize, 0x103: 1, 0x106: 1, 0x112: orientation}
    tags |= {0x115: 1, 0x116: height, 0x117: len(pixels)}
    words = {tag: (raws.LONG if tag == 0x117 else raws.SHORT, [value]) for tag, value in tags.items()}
    data = raws.tiff(words, raws.exif_tags(), order, pixels)
    frame = picture_frame(data, "a.tif")
    assert np.array_equal(frame.pixels, picture)
    # the tags are read, too, where exifread is at hand
    assert frame.exposure_s == (0.5 if find_spec("exifread") else None)

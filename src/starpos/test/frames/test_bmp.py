# SPDX-License-Identifier: Apache-2.0
"""Frames as BMP, which many cameras' programs write: whole ones are read, others refused."""

import cv2
import numpy as np
import pytest

from starpos.errors import FrameError
from starpos.frames.pictures import picture_frame
from starpos.frames.reading import read_frame


def bmp(pixels):
    return cv2.imencode(".bmp", pixels)[1].tobytes()


@pytest.mark.parametrize("shape", [(30, 41), (30, 41, 3)])
def test_a_bmp_is_read_as_it_is(shape, tmp_path, rng):
    pixels = rng.integers(0, 256, shape).astype(np.uint8)
    (tmp_path / "a.bmp").write_bytes(bmp(pixels))
    # a grey BMP has a palette, which may be read as three equal colours
    read = read_frame(tmp_path / "a.bmp").pixels
    assert np.array_equal(read if read.ndim == len(shape) else read[..., 0], pixels)


@pytest.mark.parametrize("end", [0, 1, 10, 40, 60, -1])
def test_a_cut_bmp_is_refused_in_a_sentence(end, rng):
    data = bmp(rng.integers(0, 256, (30, 40, 3)).astype(np.uint8))
    with pytest.raises(FrameError, match="not a whole PNG, TIFF, JPEG or BMP image"):
        picture_frame(data[:end], "a.bmp")


def test_a_bmp_that_claims_to_be_huge_is_refused_before_memory_is_taken(rng):
    data = bytearray(bmp(np.zeros((30, 40, 3), np.uint8)))
    data[18:26] = (2**30).to_bytes(4, "little") * 2
    with pytest.raises(FrameError):
        picture_frame(bytes(data), "a.bmp")

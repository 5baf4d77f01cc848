# SPDX-License-Identifier: Apache-2.0
"""Pixels of image messages by their encoding, against OpenCV's conversions and bits packed one by one."""

import cv2
import numpy as np
import pytest

from starpos.errors import FrameError
from starpos.frames.encodings import ENCODINGS, pixels_of

W, H, PADDING = 7, 4, 3
GREY = np.random.default_rng(5).integers(0, 4096, (H, W)).astype(np.uint16)
BGR = np.random.default_rng(6).integers(0, 256, (H, W, 3)).astype(np.uint8)
DEEP = np.random.default_rng(7).integers(0, 65536, (H, W, 3)).astype(np.uint16)


def decoded(encoding, rows, big_endian=False, after=b""):
    """What becomes of rows (h, w, ...) of numbers, with padding after each and bytes after the last."""
    rows = np.ascontiguousarray(rows)
    own = rows.view(np.uint8).reshape(H, -1)
    padded = np.concatenate([own, np.full((H, PADDING), 255, np.uint8)], 1)
    data = padded.tobytes() + after
    return pixels_of(encoding, data, W, H, padded.shape[1], big_endian, "image_raw")


@pytest.mark.parametrize("big_endian", [False, True])
@pytest.mark.parametrize("name", ["mono16", "16UC1", "16U", "bayer_gbrg16", "mono10", "mono12"])
def test_numbers_of_16_bits_are_as_they_are(name, big_endian):
    got, pattern = decoded(name, GREY.astype(">u2" if big_endian else "<u2"), big_endian)
    assert got.dtype == np.uint16 and got.dtype.isnative and np.array_equal(got, GREY)
    assert pattern == ("gbrg" if "bayer" in name else "")


@pytest.mark.parametrize("name", ["mono8", "8UC1", "8U", "bayer_rggb8"])
def test_numbers_of_8_bits_are_as_they_are(name):
    got, _ = decoded(name, BGR[:, :, 0])
    assert got.dtype == np.uint8 and np.array_equal(got, BGR[:, :, 0])


@pytest.mark.parametrize("name", ["8SC1", "8S", "16SC1", "16S"])
def test_numbers_with_a_sign_keep_their_order(name):
    kind = np.int8 if name[0] == "8" else np.int16
    given = np.random.default_rng(8).integers(np.iinfo(kind).min, np.iinfo(kind).max, (H, W)).astype(kind)
    got, _ = decoded(name, given)
    assert np.array_equal(got.astype(int), given.astype(int) - np.iinfo(kind).min)
    assert got.dtype == (np.uint8 if kind is np.int8 else np.uint16)


@pytest.mark.parametrize(
    ("name", "code"),
    [
        ("bgr8", None),
        ("8UC3", None),
        ("rgb8", cv2.COLOR_BGR2RGB),
        ("rgba8", cv2.COLOR_BGR2RGBA),
        ("bgra8", cv2.COLOR_BGR2BGRA),
    ],
)
def test_colours_of_8_bits_are_bgr(name, code):
    got, _ = decoded(name, BGR if code is None else cv2.cvtColor(BGR, code))
    assert got.dtype == np.uint8 and np.array_equal(got, BGR)


@pytest.mark.parametrize(
    ("name", "order"),
    [
        ("rgb16", (2, 1, 0)),
        ("bgr16", (0, 1, 2)),
        ("16UC3", (0, 1, 2)),
        ("bgra16", (0, 1, 2, 0)),
        ("rgba16", (2, 1, 0, 0)),
    ],
)
@pytest.mark.parametrize("big_endian", [False, True])
def test_colours_of_16_bits_are_their_mean(name, order, big_endian):
    given = DEEP[:, :, order].astype(">u2" if big_endian else "<u2")
    got, _ = decoded(name, given, big_endian)
    assert got.dtype == np.uint16
    np.testing.assert_allclose(got, DEEP.mean(2), atol=0.51)


def test_colours_with_a_sign():
    got, _ = decoded("8SC3", (BGR.astype(int) - 128).astype(np.int8))
    assert np.array_equal(got, BGR)
    got, _ = decoded("16SC3", (DEEP.astype(int) - 32768).astype(np.int16))
    np.testing.assert_allclose(got, DEEP.mean(2), atol=0.51)


@pytest.mark.parametrize(
    ("name", "code", "brightness"),
    [
        ("uyvy", cv2.COLOR_YUV2GRAY_UYVY, 1),
        ("yuv422", cv2.COLOR_YUV2GRAY_UYVY, 1),
        ("yuyv", cv2.COLOR_YUV2GRAY_YUY2, 0),
        ("yuv422_yuy2", cv2.COLOR_YUV2GRAY_YUY2, 0),
    ],
)
def test_of_yuv_the_brightness_is_taken(name, code, brightness):
    pairs = BGR[:, :, :2]
    got, _ = decoded(name, pairs)
    assert np.array_equal(got, pairs[:, :, brightness])
    # OpenCV wants whole groups of two pixels
    even = np.ascontiguousarray(pairs[:, : W - 1])
    assert np.array_equal(got[:, : W - 1], cv2.cvtColor(even, code))


@pytest.mark.parametrize("name", ["nv12", "nv21", "nv24"])
def test_of_planes_the_brightness_is_taken(name):
    got, _ = decoded(name, BGR[:, :, 0], after=b"\x07" * 40)
    assert np.array_equal(got, BGR[:, :, 0])


def bit_stream(values, bits):
    """PFNC's packing: bit k of the stream is bit k % 8 of byte k // 8, the low bits of a pixel first."""
    stream = (values[:, :, None] >> np.arange(bits)) & 1
    return np.packbits(stream.reshape(len(values), -1).astype(np.uint8), axis=1, bitorder="little")


def gige_vision(values, bits):
    """GigE Vision's: high bits of the first, low bits of both (the second's above), high bits of the second."""
    out = []
    for row in values.tolist():
        packed = []
        for k in range(0, len(row), 2):
            first, second = row[k], row[k + 1] if k + 1 < len(row) else 0
            low = (1 << bits - 8) - 1
            packed += [first >> bits - 8, first & low | (second & low) << 4, second >> bits - 8]
        # an odd last pixel has no third byte
        out.append(packed[: -(-len(row) * 3 // 2)])
    return np.array(out, np.uint8)


@pytest.mark.parametrize("name", ["Mono", "BayerRG", "BayerGB"])
@pytest.mark.parametrize("bits", [10, 12])
@pytest.mark.parametrize(("suffix", "pack"), [("p", bit_stream), ("Packed", gige_vision)])
def test_packed_pixels(name, bits, suffix, pack):
    values = GREY >> 12 - bits
    got, pattern = decoded(f"{name}{bits}{suffix}", pack(values, bits))
    assert got.dtype == np.uint16 and np.array_equal(got, values)
    assert pattern == {"Mono": "", "BayerRG": "rggb", "BayerGB": "gbrg"}[name]


def test_every_channel_of_8_and_16_bits_that_cv_bridge_knows():
    for kind in ("8U", "8S", "16U", "16S"):
        for channels in (1, 3):
            assert f"{kind}C{channels}" in ENCODINGS


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"encoding": "32FC1"}, "'32FC1' is unknown"),
        ({"encoding": ""}, "unknown"),
        ({"width": 0}, "empty"),
        ({"height": 0}, "empty"),
        ({"height": H + 1}, "truncated"),
        ({"step": 2 * W - 1}, "needs 14"),
        ({"width": 2**32 - 1}, "step"),
        ({"step": 2**32 - 1}, "truncated"),
        ({"encoding": "mono12p", "step": 10}, "needs 11"),
    ],
)
def test_what_does_not_fit_together_is_refused(change, word):
    given = {
        "encoding": "mono16",
        "data": GREY.tobytes(),
        "width": W,
        "height": H,
        "step": 2 * W,
        "big_endian": False,
    }
    with pytest.raises(FrameError, match=word):
        pixels_of(**{**given, **change}, place="image_raw")

# SPDX-License-Identifier: Apache-2.0
"""Hundreds of frames of anything: stars that hold together, or a FrameError."""

import numpy as np
import pytest

from starpos.detection import detect
from starpos.errors import FrameError
from starpos.frames.frame import PATTERNS, Frame, to_unsigned
from starpos_testing.skies.rendered import field, grid, noisy

TYPES = [
    "u1",
    "u2",
    "u4",
    "u8",
    "i1",
    "i2",
    "i8",
    ">u2",
    ">i2",
    "f2",
    "f4",
    "f8",
    ">f4",
    "c8",
    "?",
    "M8[s]",
    "S3",
]


def random_bytes(rng):
    """Any shape and type; of floats some are NaN and infinite by themselves."""
    sides = rng.integers(0, 80, rng.choice([1, 2, 2, 2, 2, 3, 4]))
    shape = (*sides[:2], 3) if len(sides) == 3 else tuple(np.minimum(sides, 12 if len(sides) > 3 else 80))
    kind = np.dtype(str(rng.choice(TYPES)))
    pixels = np.frombuffer(rng.bytes(int(np.prod(shape)) * kind.itemsize), np.uint8)
    return (pixels % 2 if kind.kind == "b" else pixels).view(kind).reshape(shape)


def random_numbers(rng):
    """What a sensor's driver may make of nothing, in a shape and a type that frames have."""
    shape = tuple(rng.integers(1, 160, 2)) + ((3,) if rng.random() < 0.2 else ())
    kind = np.uint8 if len(shape) == 3 or rng.random() < 0.5 else np.uint16
    top = np.iinfo(kind).max
    kinds = (
        lambda: rng.integers(0, top + 1, shape),
        lambda: rng.choice([0, top], shape),
        lambda: np.where(rng.random(shape) < 0.02, top, 0),
        lambda: np.clip(np.cumsum(rng.integers(-3, 4, shape), axis=1) + 100, 0, top),
        lambda: np.full(shape, rng.integers(0, top + 1)),
    )
    return kinds[rng.integers(len(kinds))]().astype(kind)


def stars_and_faults(rng):
    """Stars of poor optics, and what goes wrong with a sensor."""
    size = tuple(rng.integers(60, 160, 2))
    stars = grid(size, int(rng.integers(14, 40)), 10 ** rng.uniform(3, 6), rng)
    way = stars[:, :2] / size[::-1] - 0.5
    fwhm = rng.uniform(1, 5) * (1 + rng.uniform(0, 2) * np.hypot(*way.T))
    top = int(rng.choice([255, 4095, 65535]))
    pixels = noisy(field(size, stars, fwhm, rng.uniform(-3, 3) * way), rng, top)
    pixels[rng.integers(size[0])] = rng.choice([0, top])
    pixels[rng.random(size) < rng.choice([0, 0.003, 0.1])] = top
    if rng.random() < 0.2:
        return np.repeat(pixels[..., None] % 256, 3, 2).astype(np.uint8)
    return pixels.astype(np.uint8) if top == 255 else pixels


def floats_with_holes(rng):
    """A frame of floats, as a reduced one may be, up to 2 % of it NaN, infinite or absurdly large."""
    pixels = stars_and_faults(rng).astype(rng.choice(["f4", "f8"]))
    hole = rng.random(pixels.shape) < rng.choice([0, 0.002, 0.005, 0.02])
    pixels[hole] = rng.choice([np.nan, np.inf, -np.inf, 1e30, -1e4], hole.sum())
    return pixels


def is_answered(pixels, rng):
    """Whether there are stars: True, False; None: refused."""
    pattern = "" if pixels.ndim == 3 else str(rng.choice(PATTERNS))
    try:
        if pixels.dtype not in (np.uint8, np.uint16) and rng.random() < 0.8:
            pixels = to_unsigned(pixels, "fuzz")
        detection = detect(Frame(pixels, pattern=pattern))
    except FrameError:
        return None
    found = detection.stars
    assert np.all((found.snr > 0) & np.isfinite(found.snr) & np.isfinite(found.x) & np.isfinite(found.y))
    assert np.all(np.linalg.det(found.covariance) > 0)
    assert np.isfinite([detection.background, detection.noise]).all()
    return len(found) > 0


FRAMES = 125


@pytest.mark.montecarlo
@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    ("make", "least", "most"),
    [
        (random_bytes, 0.5, 1.0),
        (random_numbers, 0, 0),
        (stars_and_faults, 0, 0),
        (floats_with_holes, 0.1, 0.6),
    ],
)
def test_many_frames_raise_nothing_but_that_they_are_none(make, least, most):
    rng = np.random.default_rng(14)
    answers = [is_answered(make(rng), rng) for _ in range(FRAMES)]
    assert least <= answers.count(None) / FRAMES <= most
    assert (answers.count(True) > FRAMES / 25) == (make in (stars_and_faults, floats_with_holes))


@pytest.mark.parametrize("shape", [(0, 0), (0, 5), (5, 0), (0, 0, 3), (0,), ()])
@pytest.mark.parametrize("kind", [np.uint8, np.uint16, np.float32])
def test_a_frame_without_pixels_is_refused(shape, kind):
    with pytest.raises(FrameError):
        detect(Frame(np.zeros(shape, kind)))

# SPDX-License-Identifier: Apache-2.0
"""Detections that are noise are not searched; stars are, faint ones and stars of stretched pictures too."""

import cv2
import numpy as np
import pytest

from starpos.detection import detect
from starpos.fix.blind import BlindSolver
from starpos.fix.checks import why_noise
from starpos.fix.solution import Status
from starpos.frames.frame import Frame

SHAPE = (800, 1200)


def jpeg(pixels, quality):
    """Pixels that are cut off at black, after a JPEG of that quality."""
    whole = pixels.clip(0, 255).astype(np.uint8)
    stored = cv2.imencode(".jpg", whole, [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
    return detect(Frame(pixels=cv2.imdecode(stored, cv2.IMREAD_GRAYSCALE))).stars


def sky(number, gamma, rng):
    """A number of stars, distributed as on the sky, stretched by a gamma."""
    pixels = np.zeros(SHAPE)
    light = 750 * 10 ** (-0.4 * np.log10(np.arange(1, number + 1)) / 0.45)
    x, y = (rng.uniform(6, n - 6, number) for n in reversed(SHAPE))
    rows, columns = np.mgrid[-5:6, -5:6]
    for left, top, flux in zip(x, y, light, strict=True):
        i, j = round(top), round(left)
        image = flux * np.exp(-0.5 * ((rows + i - top) ** 2 + (columns + j - left) ** 2) / 1.3**2)
        pixels[i - 5 : i + 6, j - 5 : j + 6] += image
    return 255 * (pixels / 255).clip(0, 1) ** (1 / gamma)


@pytest.mark.parametrize(("level", "sigma", "quality"), [(-6, 6, 60), (-6.5, 6, 60)])
def test_the_noise_of_a_jpeg_whose_sky_is_black_is_not_searched(level, sigma, quality, catalogue, rng):
    stars = jpeg(rng.normal(level, sigma, SHAPE), quality)
    assert len(stars) > 150
    s = BlindSolver(catalogue).identify(stars)
    assert s.status is Status.NOT_IDENTIFIED and f"its {len(stars)} detections are noise" in s.message


@pytest.mark.parametrize("number", [300, 2000])
@pytest.mark.parametrize("gamma", [1.0, 2.2])
def test_stars_on_such_a_sky_are(number, gamma, rng):
    stars = jpeg(sky(number, gamma, rng) + rng.normal(-4, 4, SHAPE), 85)
    assert len(stars) > 150
    assert why_noise(stars) == ""

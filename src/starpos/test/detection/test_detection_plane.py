# SPDX-License-Identifier: Apache-2.0
import cv2
import numpy as np
import pytest

from starpos.detection import detect
from starpos.detection.background import plane_of
from starpos.frames.frame import PATTERNS, Frame
from starpos_testing.skies.rendered import field, grid, match

# OpenCV's names of them.
OF_MOSAIC = {"rggb": "BayerBG", "grbg": "BayerGB", "bggr": "BayerRG", "gbrg": "BayerGR"}


def mosaic(rng, size=(520, 520), electrons=12000.0, black=0.0):
    """Stars (N, 3) and an 8-bit mosaic of them."""
    stars = grid(size, 60, electrons, rng)
    gain = np.array([[0.6, 1.0], [1.0, 0.7]])
    light = field(size, stars, gains=np.broadcast_to(gain, (len(stars) + 1, 2, 2)))
    pixels = (rng.poisson(light) + rng.normal(0, 30, size)) / 10 + black
    return stars, np.clip(np.rint(pixels), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("pattern", [p for p in PATTERNS if p])
@pytest.mark.parametrize("method", ["", "_VNG"])
def test_an_interpolated_frame_gives_its_mosaic_back(pattern, method, rng):
    _, pixels = mosaic(rng, black=12.0)
    colours = cv2.cvtColor(pixels, getattr(cv2, f"COLOR_{OF_MOSAIC[pattern]}2BGR{method}"))
    plane, is_mosaic = plane_of(Frame(colours))
    inner = np.s_[4:-4, 4:-4]
    if method and not (colours == pixels[..., None]).any(-1)[inner].all():
        pytest.skip("this OpenCV's VNG changes what was measured")
    assert is_mosaic
    assert np.array_equal(plane[inner], pixels[inner])


def test_colours_that_were_all_measured_are_added(rng):
    colours = rng.integers(0, 40, (120, 160, 3)).astype(np.uint8)
    plane, is_mosaic = plane_of(Frame(colours))
    assert not is_mosaic
    assert np.array_equal(plane, colours.sum(2))


def test_hot_pixels_of_an_interpolated_frame_are_no_stars(rng):
    stars, pixels = mosaic(rng, black=12.0)
    y, x = rng.integers(10, 510, (2, 40))
    far = np.hypot(x[:, None] - stars[:, 0], y[:, None] - stars[:, 1]).min(1) > 14
    pixels[y[far], x[far]] = 230
    found = detect(Frame(cv2.cvtColor(pixels, cv2.COLOR_BayerBG2BGR))).stars
    assert np.all(match(found, stars) >= 0)
    assert len(found) == len(stars)


def test_a_sky_cut_off_at_black_hides_no_star_and_makes_none(rng):
    stars, pixels = mosaic(rng, electrons=6000.0, black=-3.0)
    assert np.median(pixels) == 0
    found = detect(Frame(pixels, pattern="rggb")).stars
    index = match(found, stars)
    assert np.mean(index >= 0) > 0.97
    brightest = set(range(int(0.9 * len(stars))))
    # What noise makes comes after them.
    assert brightest <= set(index)
    error = np.stack([found.x[index], found.y[index]], 1)[index >= 0] - stars[index >= 0, :2]
    assert np.all(np.abs(error.mean(0)) < 0.05)

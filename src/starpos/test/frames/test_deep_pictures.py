# SPDX-License-Identifier: Apache-2.0
"""Pictures of astronomy programs: 16 bits and floats, grey and colour, without losing their faint stars."""

import cv2
import numpy as np
import pytest

from starpos.detection import detect
from starpos.errors import FrameError
from starpos.frames.reading import read_frame


def sky(rng, stars=40, sky_dn=300.0, noise_dn=8.0):
    """A linear picture (h, w) of 16 bits, as a camera gives it: all but the brightest stars below 1 % of full scale."""
    y, x = np.mgrid[:200, :300]
    light = rng.normal(sky_dn, noise_dn, x.shape)
    place = rng.uniform(10, [290, 190], (stars, 2))
    for (cx, cy), peak in zip(place, np.geomspace(80, 20000, stars), strict=True):
        light += peak * np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / (2 * 1.3**2))
    return light.clip(0, 65535)


def found(path):
    return len(detect(read_frame(path)).stars)


@pytest.mark.parametrize("suffix", [".png", ".tif"])
def test_colours_of_16_bits_show_as_many_stars_as_grey(tmp_path, rng, suffix):
    grey = sky(rng)
    cv2.imwrite(str(tmp_path / f"grey{suffix}"), grey.astype(np.uint16))
    cv2.imwrite(str(tmp_path / f"colour{suffix}"), np.dstack([grey] * 3).astype(np.uint16))
    frame = read_frame(tmp_path / f"colour{suffix}")
    assert frame.pixels.shape == grey.shape and frame.pixels.dtype == np.uint16
    assert np.abs(frame.pixels - np.floor(grey)).max() <= 1
    assert found(tmp_path / f"colour{suffix}") == found(tmp_path / f"grey{suffix}") >= 35


@pytest.mark.parametrize(("depth", "channels"), [(np.float32, 1), (np.float32, 3), (np.float64, 1)])
def test_a_tiff_of_floats_from_0_to_1_shows_as_many_stars(tmp_path, rng, depth, channels):
    grey = sky(rng)
    cv2.imwrite(str(tmp_path / "grey.png"), grey.astype(np.uint16))
    values = (grey / 65535).astype(depth)
    assert cv2.imwrite(str(tmp_path / "a.tif"), np.dstack([values] * channels).squeeze())
    frame = read_frame(tmp_path / "a.tif")
    assert frame.pixels.shape == grey.shape and frame.pixels.dtype == np.uint16
    assert abs(found(tmp_path / "a.tif") - found(tmp_path / "grey.png")) <= 1


def test_colours_are_averaged(tmp_path):
    planes = [np.full((20, 30), dn, np.uint16) for dn in (300, 600, 60000)]
    cv2.imwrite(str(tmp_path / "a.png"), np.dstack(planes))
    assert (read_frame(tmp_path / "a.png").pixels == 20300).all()


def test_a_tiff_of_floats_that_are_no_numbers_is_refused(tmp_path):
    for value in (np.nan, np.inf):
        cv2.imwrite(str(tmp_path / "a.tif"), np.full((20, 30), value, np.float32))
        with pytest.raises(FrameError, match=r"NaN or infinite"):
            read_frame(tmp_path / "a.tif")


def test_a_cut_tiff_of_floats_is_refused(tmp_path, rng):
    cv2.imwrite(str(tmp_path / "a.tif"), (sky(rng) / 65535).astype(np.float32))
    whole = (tmp_path / "a.tif").read_bytes()
    for end in (10, 1000, len(whole) // 2, len(whole) - 1):
        (tmp_path / "a.tif").write_bytes(whole[:end])
        with pytest.raises(FrameError, match="not a whole"):
            read_frame(tmp_path / "a.tif")

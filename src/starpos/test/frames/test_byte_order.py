# SPDX-License-Identifier: Apache-2.0
"""Pixels whose two bytes were written in the wrong order are refused; odd but right ones are read."""

import numpy as np
import pytest
from astropy.io import fits

from starpos.errors import FrameError
from starpos.frames.reading import read_frame


def sky(background, noise, bright=20000.0):
    rng = np.random.default_rng(1)
    values = rng.normal(background, noise, (240, 320))
    y, x = np.mgrid[:240, :320]
    for cx, cy in rng.uniform(10, 230, (40, 2)):
        values += rng.uniform(0.05, 1) * bright * np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / 4)
    return np.clip(values, 0, 65535).astype(np.uint16)


def read(path, values):
    fits.PrimaryHDU(values).writeto(path)
    return read_frame(path)


@pytest.mark.parametrize(("background", "noise"), [(300, 8), (1000, 30), (5000, 60)])
def test_swapped_bytes_are_named(tmp_path, background, noise):
    with pytest.raises(FrameError, match="bytes of its pixels are in the wrong order"):
        read(tmp_path / "a.fits", sky(background, noise).byteswap())


@pytest.mark.parametrize(
    "values",
    [
        sky(300, 8),
        sky(100, 0.3),
        sky(20000, 3000),
        # 8, 10 and 12 bits at the upper end, and 8 bits times 257
        sky(10, 3, 200) << 8,
        sky(60, 12, 900) << 6,
        sky(200, 30, 3800) << 4,
        sky(10, 3, 200) * np.uint16(257),
    ],
    ids=["usual", "hardly noisy", "very noisy", "8 bits", "10 bits", "12 bits", "8 bits, scaled"],
)
def test_right_bytes_are_read(tmp_path, values):
    assert (read(tmp_path / "a.fits", values).pixels == values).all()

# SPDX-License-Identifier: Apache-2.0
"""Cells of the background and pixels around stars, of compiled code, against their plain forms."""

import numpy as np
import pytest

from starpos.detection._pixels import cut_stamps
from starpos.detection._sky import sample_sky
from starpos.detection.background import CLIP
from starpos.units import SIGMA_PER_MAD


def plain_cell(values):
    """Clipped mean and rms of values (n,)."""
    middle = np.sort(values)[len(values) // 2]
    spread = SIGMA_PER_MAD * np.sort(np.abs(values - middle))[len(values) // 2]
    if spread == 0:
        spread = np.subtract(*np.quantile(values, (0.9, 0.75))) / 0.607
    kept = values[np.abs(values - middle) <= max(3.5 * spread, 1.0)]
    return kept.mean(), kept.std(ddof=1 if len(kept) > 1 else 0) / 0.9969


@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
def test_cells_are_those_of_sorted_values(kind, rng):
    plane = np.clip(np.rint(rng.normal(100, 9, (40, 56))), 0, 255).astype(kind)
    # a star, and a sky cut off at 0
    plane[4:8, 4:8] = 255
    plane[20:, 28:] = np.where(rng.random((20, 28)) < 0.7, 0, plane[20:, 28:])
    rows = np.stack([np.arange(0, 20), np.arange(20, 40)]).astype(np.int32)
    columns = np.stack([np.arange(0, 28), np.arange(28, 56)]).astype(np.int32)
    level, noise, highest, count = sample_sky(plane, rows, columns, *CLIP)
    for i, j, phase in np.ndindex(2, 2, 4):
        values = plane[rows[i, phase // 2 :: 2]][:, columns[j, phase % 2 :: 2]].ravel().astype(float)
        expected = *plain_cell(values), values.max(), (values == values.max()).sum()
        found = [a[phase, i, j] for a in (level, noise, highest, count)]
        np.testing.assert_allclose(found, expected, rtol=1e-12)


@pytest.mark.parametrize("phases", [1, 4])
@pytest.mark.parametrize(("kind", "most"), [(np.uint8, 250), (np.uint16, 1000)])
@pytest.mark.parametrize("saturation", [0.9, 0.9001, np.inf])
def test_stamps_are_the_pixels_around_stars(phases, kind, most, saturation, rng):
    """Some lie partly, or wholly, beyond the frame."""
    plane = rng.integers(0, most, (30, 20)).astype(kind)
    saturation *= most
    x, y = rng.integers(-9, 29, (2, 40))
    level, noise = rng.uniform(0, 9, (2, 40, phases)).astype(np.float32)
    columns, rows = x[:, None, None] + np.arange(-3, 4), y[:, None, None] + np.arange(-3, 4)[:, None]
    columns, rows = np.broadcast_arrays(columns, rows)
    pixels = plane[np.clip(rows, 0, 29), np.clip(columns, 0, 19)]
    on = (rows >= 0) & (rows < 30) & (columns >= 0) & (columns < 20)
    phase = (2 * (rows % 2) + columns % 2) * (phases > 1)
    each = np.arange(40)[:, None, None]
    expected = (
        pixels - level[each, phase],
        noise[each, phase],
        on & (pixels < saturation),
        on & (pixels >= saturation),
        phase,
    )
    for found, plain in zip(cut_stamps(plane, x, y, 3, level, noise, saturation), expected, strict=True):
        np.testing.assert_array_equal(found, plain)


def test_what_lies_beyond_the_frame_is_refused():
    plane, rows = np.zeros((8, 8), np.uint16), np.array([[0, 1, 8, 9]], np.int32)
    with pytest.raises(ValueError, match="beyond"):
        sample_sky(plane, rows, rows, *CLIP)
    with pytest.raises(ValueError, match="pairs"):
        sample_sky(plane, rows[:, :3].copy(), rows, *CLIP)
    with pytest.raises(ValueError, match="phases"):
        cut_stamps(plane, np.zeros(2, int), np.zeros(1, int), 1, *np.zeros((2, 2, 1), np.float32), 1.0)
    with pytest.raises(ValueError, match="nothing to see"):
        cut_stamps(plane, np.zeros(1, int), np.zeros(1, int), -1, *np.zeros((2, 1, 1), np.float32), 1.0)

# SPDX-License-Identifier: Apache-2.0
"""Evidence of pixels next to peaks, by compiled code, against its plain form on stamps of them."""

import numpy as np
import pytest

from starpos.detection._pixels import cut_stamps, measure_rims, sum_squares
from starpos.units import SIGMA_PER_MAD


@pytest.fixture(params=[(1, np.uint8), (1, np.uint16), (4, np.uint8), (4, np.uint16)], ids=str)
def peaks(request, rng):
    """A plane with hot pixels, alone and in pairs, and peaks at random: some of them lie partly beyond the frame."""
    phases, kind = request.param
    plane = rng.integers(80, 120, (60, 50)).astype(kind)
    x, y = rng.integers(-2, 52, (2, 300))
    on = (x >= 0) & (x < 50) & (y >= 0) & (y < 60)
    plane[y[on][:60], x[on][:60]] = rng.integers(150, 256 if kind is np.uint8 else 2000, 60)
    plane[y[on][:20], np.minimum(x[on][:20] + 1, 49)] = 250
    level = rng.uniform(98, 102, (300, phases)).astype(np.float32)
    noise = rng.uniform(9, 12, (300, phases)).astype(np.float32)
    return plane, x, y, level, noise


def squares(peaks, reach):
    """Signal and noise (N, pixels) around the peaks."""
    plane, x, y, level, noise = peaks
    return [
        values.reshape(len(x), -1).astype(float)
        for values in cut_stamps(plane, x, y, reach, level, noise, 1e9)[:2]
    ]


@pytest.mark.parametrize("reach", [1, 2])
def test_sums_over_squares_are_those_of_stamps(reach, peaks):
    signal, noise = squares(peaks, reach)
    ordered = np.sort(signal, axis=1)
    expected = signal.sum(1), ordered[:, -1], ordered[:, -2], np.sqrt((noise**2).sum(1))
    np.testing.assert_allclose(sum_squares(*peaks, reach), expected, rtol=1e-12)


@pytest.mark.parametrize("reach", [1, 3])
def test_rims_are_the_edges_of_squares(reach, peaks):
    """Beyond the frame they are its nearest pixels, each of its own phase."""
    plane, x, y, level, noise = peaks
    rows, columns = np.mgrid[-reach : reach + 1, -reach : reach + 1].reshape(2, -1)
    edge = np.maximum(np.abs(rows), np.abs(columns)) == reach
    rows = np.clip(y[:, None] + rows[edge], 0, 59)
    columns = np.clip(x[:, None] + columns[edge], 0, 49)
    phase = (2 * (rows % 2) + columns % 2) * (level.shape[1] > 1)
    each = np.arange(len(x))[:, None]
    score = (plane[rows, columns] - level[each, phase]).astype(float) / noise[each, phase]
    sky = np.median(score, axis=1)
    spread = SIGMA_PER_MAD * np.median(np.abs(score - sky[:, None]), axis=1)
    assert 20 < (sky > 0.3).sum() < 280 and 20 < (spread > 1.3).sum() < 280
    expected = np.where(sky > 0.3, sky, 0), np.where(spread > 1.3, spread, 1)
    np.testing.assert_allclose(
        measure_rims(*peaks, reach, SIGMA_PER_MAD, 0.3, 1.3), expected, rtol=1e-6, atol=1e-6
    )


def test_columns_that_do_not_fit_together_are_refused(peaks):
    plane, x, y, level, noise = peaks
    with pytest.raises(ValueError, match="phases"):
        sum_squares(plane, x, y[1:], level, noise, 1)
    with pytest.raises(ValueError, match="phases"):
        sum_squares(plane, x, y, level, noise[:, :0], 2)
    with pytest.raises(ValueError, match="no edge"):
        measure_rims(*peaks, 0, 1.0, 0.0, 0.0)
    with pytest.raises(ValueError, match="nothing to see"):
        sum_squares(plane[:0], x, y, level, noise, 1)

# SPDX-License-Identifier: Apache-2.0
"""What pixels beside peaks tell, by the compiled core, beside its plain form on stamps of them."""

import numpy as np
import pytest

from starpos.core.beside import dots, lonely, rims
from starpos.core.stamps import around
from starpos.normal import SIGMA_PER_MAD


@pytest.fixture(params=[1, 4])
def peaks(request, rng):
    """A plane with hot pixels, alone and in pairs, and peaks at random: some of them lie partly beyond the frame."""
    plane = rng.integers(80, 120, (60, 50)).astype(np.uint16)
    x, y = rng.integers(-2, 52, (2, 300))
    on = (x >= 0) & (x < 50) & (y >= 0) & (y < 60)
    plane[y[on][:60], x[on][:60]] += rng.integers(100, 2000, 60).astype(np.uint16)
    plane[y[on][:20], np.minimum(x[on][:20] + 1, 49)] += 500
    level = rng.uniform(98, 102, (300, request.param)).astype(np.float32)
    noise = rng.uniform(9, 12, (300, request.param)).astype(np.float32)
    return plane, x, y, level, noise


def squares(peaks, reach):
    """Signal and noise (N, pixels) around the peaks."""
    plane, x, y, level, noise = peaks
    return [
        values.reshape(len(x), -1).astype(float)
        for values in around(plane, x, y, reach, level, noise, 1e9)[:2]
    ]


def test_dots_have_their_light_in_one_or_two_pixels(peaks):
    core = np.sort(squares(peaks, 1)[0], axis=1)
    peak, second, rest = core[:, 8], core[:, 7], core[:, :7].sum(1)
    expected = (rest + second < 0.5 * peak) | (rest < 0.25 * peak)
    assert 20 < expected.sum() < 280
    np.testing.assert_array_equal(dots(*peaks[:4], 0.5, 0.25), expected)


@pytest.mark.parametrize("reach", [1, 2])
def test_lonely_pixels_have_no_light_beside_them(reach, peaks):
    signal, noise = squares(peaks, reach)
    beside = signal.sum(1) - signal.max(1)
    expected = beside < np.minimum(0.25 * signal.max(1), 3.0 * np.sqrt((noise**2).sum(1)))
    assert 20 < expected.sum() < 280
    np.testing.assert_array_equal(lonely(*peaks, reach, 0.25, 3.0), expected)


@pytest.mark.parametrize("reach", [1, 3])
def test_rims_are_the_edges_of_stamps(reach, peaks):
    inside = (peaks[1] >= reach) & (peaks[1] < 50 - reach) & (peaks[2] >= reach) & (peaks[2] < 60 - reach)
    peaks = peaks[0], *(np.ascontiguousarray(column[inside]) for column in peaks[1:])
    rows, columns = np.mgrid[-reach : reach + 1, -reach : reach + 1].reshape(2, -1)
    signal, noise = (v[:, np.maximum(np.abs(rows), np.abs(columns)) == reach] for v in squares(peaks, reach))
    level = np.median(signal / noise, axis=1)
    spread = SIGMA_PER_MAD * np.median(np.abs(signal / noise - level[:, None]), axis=1)
    assert 20 < (level > 0.3).sum() < len(level) - 20 and 20 < (spread > 1.3).sum() < len(level) - 20
    expected = np.where(level > 0.3, level, 0), np.where(spread > 1.3, spread, 1)
    np.testing.assert_allclose(rims(*peaks, reach, SIGMA_PER_MAD, 0.3, 1.3), expected, rtol=1e-9, atol=1e-9)


def test_beyond_the_frame_a_rim_is_the_nearest_pixels():
    plane = np.arange(12, dtype=np.uint8).reshape(3, 4)
    level, noise = np.zeros((1, 1), np.float32), np.ones((1, 1), np.float32)
    rows, columns = np.clip(np.mgrid[-1:6, -1:6] - 2, 0, [[[2]], [[3]]])
    edge = np.ones((7, 7), bool)
    edge[1:-1, 1:-1] = False
    middle, spread = rims(plane, np.zeros(1, int), np.zeros(1, int), level, noise, 3, 1.0, 0.0, 0.0)
    expected = plane[rows, columns][edge].astype(float)
    assert middle == np.median(expected)
    assert spread == np.median(np.abs(expected - np.median(expected)))


def test_columns_that_do_not_fit_together_are_refused(peaks):
    plane, x, y, level, noise = peaks
    with pytest.raises(ValueError, match="phases"):
        dots(plane, x, y[1:], level, 0.5, 0.25)
    with pytest.raises(ValueError, match="phases"):
        lonely(plane, x, y, level, noise[:, :0], 2, 0.25, 3.0)
    with pytest.raises(ValueError, match="no edge"):
        rims(*peaks, 0, 1.0, 0.0, 0.0)
    with pytest.raises(ValueError, match="nothing to see"):
        dots(plane[:0], x, y, level, 0.5, 0.25)

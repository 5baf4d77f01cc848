# SPDX-License-Identifier: Apache-2.0
"""Meshes of the sky, sparse looks at a frame, and medians, of compiled code, against their plain forms."""

import numpy as np
import pytest
from scipy import ndimage

from starpos.detection._peaks import find_maxima, smooth_rows
from starpos.detection._pixels import any_flat, bright_squares, third_highest
from starpos.detection._sky import even_out, interpolated, median, quantile, scores, sky_at
from starpos.detection.finding import SHARP, WIDE


def plain_evened(mesh, steep, level):
    """A mesh (rows, columns), evened out by scipy."""
    around = np.pad(mesh, 2, "reflect", reflect_type="odd")
    typical = ndimage.median_filter(around, 3)
    even, typical = ndimage.uniform_filter(typical, 3)[2:-2, 2:-2], typical[2:-2, 2:-2]
    mesh = np.where(np.abs(even - typical) < steep, even, typical)
    return np.pad(mesh, 1, "edge") if level else np.pad(mesh, 1, "reflect", reflect_type="odd")


@pytest.mark.parametrize("level", [False, True])
@pytest.mark.parametrize("size", [(1, 1), (1, 2), (2, 1), (2, 2), (3, 5), (18, 27)])
def test_a_mesh_is_evened_as_by_filters(size, level, rng):
    mesh, steep = rng.normal(0, 1, (3, *size)), np.array([0.0, 0.3, 9.0])
    plain = [plain_evened(m, s, level) for m, s in zip(mesh, steep, strict=True)]
    np.testing.assert_allclose(even_out(mesh, steep, level), plain, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("phases", [1, 4])
def test_scores_are_those_of_single_places(phases, rng):
    level, noise = rng.uniform(5, 9, (2, phases, 4, 6))
    row, column = np.sort(rng.uniform(0, 2.99, 7)), np.sort(rng.uniform(0, 4.99, 11))
    value = rng.normal(0, 100, (7, 11)).astype(np.float32)
    places = [v.ravel() for v in np.meshgrid(row, column, indexing="ij")]
    sky, sigma = interpolated(level, *places).mean(1), np.sqrt((interpolated(noise, *places) ** 2).mean(1))
    plain = ((value.ravel() - sky) / sigma).reshape(value.shape)
    np.testing.assert_allclose(scores(value, level, noise, row, column), plain, rtol=1e-5)
    with pytest.raises(ValueError, match="a mesh of 4"):
        scores(value, level, noise, row + 1, column)


@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
def test_some_rows_are_smoothed_as_by_convolution(kind, rng):
    plane, weight = rng.integers(0, 255, (9, 30)).astype(kind), np.array([0.4, 0.2, 0.1], np.float32)
    both = np.concatenate([weight[:0:-1], weight])
    plain = plane.astype(float)
    for axis in (0, 1):
        plain = ndimage.convolve1d(plain, both, axis=axis, mode="mirror")
    rows = np.array([0, 4, 8])
    np.testing.assert_allclose(smooth_rows(plane, weight, rows, 4), plain[rows, ::4], rtol=1e-5)
    with pytest.raises(ValueError, match="beyond"):
        smooth_rows(plane, weight, rows + 1, 4)


@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
@pytest.mark.parametrize("step", [1, 3, 4])
def test_bright_squares_are_those_of_slices(kind, step, rng):
    plane = rng.integers(0, 200, (41, 34)).astype(kind)
    # most rows have nothing
    plane[rng.random(41) < 0.7] = 3
    row, column = np.nonzero(plane[:-1:step, :-1:step] > 120)
    row, column = row * step, column * step
    low = np.min([plane[row + i, column + j] for i in (0, 1) for j in (0, 1)], axis=0)
    squares = bright_squares(plane, plane.max(1).astype(np.int32), step, 120)
    for found, plain in zip(squares, (row, column, low), strict=True):
        np.testing.assert_array_equal(found, plain)


def test_a_frame_of_one_row_has_no_squares():
    assert not any(
        len(column) for column in bright_squares(np.full((1, 9), 9, np.uint8), np.full(1, 9, np.int32), 2, 1)
    )


def test_flat_blocks_are_found_and_black_ones_are_not(rng):
    plane, some = rng.integers(1, 9, (40, 64)).astype(np.uint8), (np.arange(0, 5, 2), np.arange(1, 8, 2))
    plane[8:16, 24:32], plane[16:24, 24:32] = 7, 0
    assert not any_flat(plane, *some)
    plane[16:24, 24:32] = 7
    assert any_flat(plane, *some)
    plane[23, 31] = 8
    assert not any_flat(plane, *some)
    with pytest.raises(ValueError, match="beyond"):
        any_flat(plane, some[0] + 1, some[1])


@pytest.mark.parametrize("n", [1, 2, 9, 100])
def test_medians_and_quantiles_are_those_of_numpy(n, rng):
    values = rng.normal(0, 1, n)
    assert median(values) == pytest.approx(np.median(values), abs=1e-15)
    for share in (0, 0.3, 0.97, 1):
        assert quantile(values, share) == pytest.approx(np.quantile(values, share), abs=1e-15)
    assert np.isnan(median(np.append(values, np.nan)))


def test_nothing_has_no_median_and_no_quantile():
    assert np.isnan(median(np.zeros(0)))
    with pytest.raises(ValueError, match="there is none"):
        quantile(np.zeros(0), 0.5)


@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
@pytest.mark.parametrize("reach", [1, 2])
def test_the_third_highest_pixel_is_that_of_sorted_squares(kind, reach, rng):
    """Some squares lie partly beyond the frame, where there is no light."""
    for most in (3, 9, 200):
        plane = rng.integers(0, most, (20, 30)).astype(kind)
        y, x = (v.ravel() for v in np.indices(plane.shape))
        around, size = np.pad(plane, reach), 2 * reach + 1
        squares = np.stack([around[j : j + size, i : i + size].ravel() for i, j in zip(x, y, strict=True)])
        third, alike = third_highest(plane, x, y, reach)
        np.testing.assert_array_equal(third, np.sort(squares, axis=1)[:, -3])
        lit = third > 0
        np.testing.assert_array_equal(alike[lit], (squares == third[:, None]).sum(1)[lit])
    with pytest.raises(ValueError, match="as many"):
        third_highest(plane, x, y[1:], reach)


@pytest.mark.parametrize("phases", [1, 4])
def test_the_sky_near_a_pixel_lies_between_cells(phases, rng):
    level, noise = rng.uniform(5, 9, (2, phases, 5, 8))
    x, y = rng.integers(-3, 63, 40), rng.integers(-3, 33, 40)
    place = (y + 0.5) * 3 / 30 + 0.5, (x + 0.5) * 6 / 60 + 0.5
    plain = interpolated(level, *place), interpolated(noise, *place) * 1.5
    for found, expected in zip(sky_at(level, noise, x, y, 60, 30, 1.5), plain, strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-6)
    with pytest.raises(ValueError, match="as many"):
        sky_at(level, noise, x, y[1:], 60, 30, 1.5)
    with pytest.raises(ValueError, match="as of level"):
        sky_at(level, noise[:, 1:].copy(), x, y, 60, 30, 1.5)


@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
@pytest.mark.parametrize("kernel", [SHARP, WIDE])
def test_peaks_in_blocks_that_are_left_out_or_not_are_those_of_the_whole_smoothed_plane(kind, kernel, rng):
    plane = rng.integers(0, 60, (70, 300)).astype(kind)
    plane[rng.random(plane.shape) < 0.01] += 190
    # a flat half, whose blocks are dark
    plane[:, :150] //= 8
    smooth = smooth_rows(plane, kernel.weight, np.arange(70), 1)
    highest = ndimage.maximum_filter(smooth, 2 * kernel.flat + 1, mode="nearest")
    limit = np.quantile(smooth, 0.9)
    row, column = np.nonzero((smooth == highest) & (smooth > limit))
    cells = np.full((2, 4), limit, np.float32)
    x, y, value, _ = find_maxima(plane, kernel.weight, kernel.flat, cells, 40, 0, 70)
    np.testing.assert_array_equal((y, x, value), (row, column, smooth[row, column]))


def test_the_limit_of_peaks_is_linear_between_cells_and_another_in_each_strip(rng):
    plane, cells = np.zeros((20, 60), np.uint16), rng.uniform(100, 200, (2, 8)).astype(np.float32)
    row, column = (v.ravel() for v in np.mgrid[1:20:3, 1:60:3])
    plane[row, column] = height = rng.integers(50, 250, len(row))
    place = (column + 0.5) * 6 / 60 + 0.5
    limit = np.where(row < 10, *(np.interp(place, np.arange(8), strip) for strip in cells))
    x, y, value, highest = find_maxima(plane, np.array([1, 0], np.float32), 1, cells, 10, 0, 20)
    np.testing.assert_array_equal((y, x, value), np.stack([row, column, height])[:, height > limit])
    np.testing.assert_array_equal(highest, plane.max(1))
    with pytest.raises(ValueError, match="2 strips"):
        find_maxima(plane, np.array([1, 0], np.float32), 1, cells, 9, 0, 20)

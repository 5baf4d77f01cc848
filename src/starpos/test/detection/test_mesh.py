# SPDX-License-Identifier: Apache-2.0
"""Meshes of the sky, sparse looks at a frame, and medians, of compiled code, against their plain forms."""

import numpy as np
import pytest
from scipy import ndimage

from starpos.detection._peaks import find_maxima, smooth_rows
from starpos.detection._pixels import any_flat, third_highest
from starpos.detection._sky import median, sky_at
from starpos.detection.background import _beyond, _evened, between
from starpos.detection.finding import SHARP, WIDE


@pytest.mark.parametrize("size", [(1, 1), (1, 2), (2, 1), (2, 2), (3, 5), (18, 27)])
def test_a_mesh_is_evened_as_by_filters(size, rng):
    mesh, steep = rng.normal(60000, 1, (3, *size)), np.array([0.0, 0.3, 9.0])
    for found, one, limit in zip(_evened(mesh, steep), mesh, steep, strict=True):
        typical = ndimage.median_filter(np.pad(one, 2, "reflect", reflect_type="odd"), 3)
        even, typical = ndimage.uniform_filter(typical, 3)[2:-2, 2:-2], typical[2:-2, 2:-2]
        plain = np.where(np.abs(even - typical) < limit, even, typical)
        np.testing.assert_allclose(found, plain, rtol=0, atol=1e-5)


@pytest.mark.parametrize("size", [(1, 1), (1, 2), (2, 3), (5, 8)])
def test_a_mesh_goes_on_beyond_its_edges_as_numpy_pads_it(size, rng):
    mesh = rng.normal(0, 1, (2, *size))
    for cells in (1, 2):
        sides = (0, 0), (cells, cells), (cells, cells)
        plain = np.pad(mesh, sides, "reflect", reflect_type="odd")
        np.testing.assert_allclose(_beyond(mesh, cells), plain, rtol=0, atol=1e-13)
        np.testing.assert_array_equal(_beyond(mesh, cells, 0.0), np.pad(mesh, sides, "edge"))


def test_meshes_are_linear_between_their_cells(rng):
    mesh = rng.normal(0, 1, (2, 5, 8))
    rows, columns = rng.uniform(0, 3.99, 9), rng.uniform(0, 6.99, 11)
    places = np.meshgrid(rows, columns, indexing="ij")
    for found, one in zip(between(mesh, rows, columns), mesh, strict=True):
        plain = ndimage.map_coordinates(one, places, order=1)
        np.testing.assert_allclose(found, plain, rtol=1e-12, atol=1e-12)


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
def test_medians_are_those_of_numpy(n, rng):
    values = rng.normal(0, 1, n)
    assert median(values) == pytest.approx(np.median(values), abs=1e-15)
    assert np.isnan(median(np.append(values, np.nan)))
    assert np.isnan(median(np.zeros(0)))


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
    level_there, noise_there = (
        np.transpose([ndimage.map_coordinates(m, place, order=1, mode="nearest") for m in mesh])
        for mesh in (level, noise)
    )
    found = sky_at(level, noise, x, y, 60, 30, 1.5)
    np.testing.assert_allclose(found, (level_there, noise_there * 1.5), rtol=1e-6)
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

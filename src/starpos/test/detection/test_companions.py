# SPDX-License-Identifier: Apache-2.0
"""Near points, light that a fit leaves, and fluxes of phases, of compiled code, against their plain forms."""

import numpy as np
import pytest
from scipy import ndimage, sparse, spatial

from starpos.detection._learn import phase_fluxes, unit_light
from starpos.detection._neighbours import any_near, group_points, near_pairs
from starpos.detection._pixels import smooth_mosaic
from starpos.detection._vetting import brightest_left


@pytest.mark.parametrize("number", [1, 2, 30, 300])
@pytest.mark.parametrize("share", [0.3, 0.6, 1.2])
def test_groups_are_the_connected_components_of_a_graph(number, share, rng):
    x, y = rng.uniform(0, 100, (2, number))
    pairs = rng.permutation(near_pairs(x, y, share * 100 / number**0.5))
    graph = sparse.coo_matrix((np.ones(len(pairs)), pairs.T), (number, number))
    expected = sparse.csgraph.connected_components(graph, directed=False)[1]
    np.testing.assert_array_equal(group_points(pairs, number), expected)
    np.testing.assert_array_equal(group_points(np.ascontiguousarray(pairs[:, ::-1]), number), expected)


def test_a_pair_of_what_is_no_point_is_refused():
    for pair in ([0, 3], [-1, 0]):
        with pytest.raises(ValueError, match="3 points"):
            group_points(np.array([pair]), 3)


@pytest.mark.parametrize("number", [0, 1, 2, 300])
def test_near_pairs_are_those_of_a_tree(number, rng):
    # whole px: many are equally far, and exactly as far as the reach
    x, y = rng.integers(0, 60, (2, number)).astype(float)
    expected = spatial.cKDTree(np.stack([x, y], 1)).query_pairs(5.0, output_type="ndarray")
    found = near_pairs(x, y, 5.0)
    assert sorted(map(tuple, found)) == sorted(map(tuple, expected))


def test_what_is_no_number_is_near_nothing():
    x, y = np.array([1.0, np.nan, 1.0, 2.0]), np.array([1.0, 1.0, np.nan, 1.0])
    assert near_pairs(x, y, 3.0).tolist() == [[0, 3]]
    with pytest.raises(ValueError, match="4 columns and 3 rows"):
        near_pairs(x, y[:3], 3.0)


@pytest.mark.parametrize("number", [0, 1, 300])
def test_points_near_others_are_those_of_distances(number, rng):
    # whole px: many are exactly as far as the reach, which is not near
    (x, y), others = (
        rng.integers(0, 60, (2, number)).astype(float),
        rng.integers(0, 60, (2, 200)).astype(float),
    )
    y[number // 2 : number // 2 + 3] = np.nan
    apart = np.hypot(x[:, None] - others[0], y[:, None] - others[1])
    np.testing.assert_array_equal(any_near(x, y, *others, 5.0), (apart < 5).any(0))
    with pytest.raises(ValueError, match="as many"):
        any_near(x, y, others[0], others[1, 1:], 5.0)


@pytest.mark.parametrize("phases", [1, 4])
def test_light_over_fluxes_and_gains_is_that_of_plain_sums(phases, rng):
    shape = 3, 5, 5
    signal, model = rng.normal(9, 9, (2, *shape)).astype(np.float32)
    noise = rng.uniform(1, 2, shape).astype(np.float32)
    phase, used = rng.integers(0, phases, shape).astype(np.uint8), rng.random(shape) < 0.7
    flux, gains = rng.uniform(9, 99, 3), rng.uniform(0.5, 1.5, (3, phases))
    scale = flux[:, None, None] * gains[np.arange(3)[:, None, None], phase]
    light = np.maximum(model.astype(float), 0)
    weight = used * scale**2 / (noise.astype(float) ** 2 + 0.3 * light + 0.01 * light**2)
    given = signal, noise, phase, model, used, flux, gains, 0.3, 0.01
    for found, plain in zip(unit_light(*given), (signal / scale, weight), strict=True):
        np.testing.assert_allclose(found, plain, rtol=1e-5)
    for which, wrong in ((2, phase + 4), (5, flux[1:]), (3, model[:, 1:].copy())):
        with pytest.raises(ValueError, match=r"needed|phase|model"):
            unit_light(*given[:which], wrong.astype(given[which].dtype), *given[which + 1 :])


def test_images_are_made_grey_as_by_two_convolutions(rng):
    images, weight = rng.normal(0, 9, (5, 7, 7)).astype(np.float32), np.array([0.25, 0.5, 0.25])
    expected = ndimage.convolve1d(
        ndimage.convolve1d(images, weight, axis=1, mode="nearest"), weight, axis=2, mode="nearest"
    )
    np.testing.assert_allclose(smooth_mosaic(images), expected, atol=1e-5)


def test_the_brightest_pixel_left_is_that_of_a_filtered_image(rng):
    residual, good = rng.normal(0, 1, (30, 15, 15)).astype(np.float32), rng.random((30, 15, 15)) < 0.9
    left, top = rng.uniform(-8, -6, (2, 30))
    axes = np.array([[0.5, 0.2], [-0.2, 0.7]]) * rng.uniform(0.8, 1.2, (30, 1, 1))
    weight = np.exp(-0.5 * (np.arange(4) / 0.8) ** 2)
    weight /= 2 * weight.sum() - weight[0]
    dx, dy = (left[:, None] + np.arange(15))[:, None, :], (top[:, None] + np.arange(15))[:, :, None]
    dx, dy = np.broadcast_arrays(dx, dy)
    u, v = np.einsum("nij,jnab->inab", axes, np.stack([dx, dy]))
    smooth = ndimage.gaussian_filter((good * residual).astype(float), (0, 0.8, 0.8))
    smooth[(dx**2 + dy**2 < 1) | (u**2 + v**2 >= 9)] = -np.inf
    expected = np.divmod(smooth.reshape(30, -1).argmax(1), 15)
    found = brightest_left(residual, good.view(np.uint8), left, top, axes, 1.0, 3.0, weight)
    np.testing.assert_array_equal(found, expected)


def test_fluxes_of_phases_are_weighted_means(rng):
    signal, noise = (
        rng.normal(50, 20, (8, 7, 7)).astype(np.float32),
        rng.uniform(2, 4, (8, 7, 7)).astype(np.float32),
    )
    value, good = rng.uniform(0, 0.1, (8, 7, 7)).astype(np.float32), rng.random((8, 7, 7)) < 0.8
    phase = rng.integers(0, 4, (8, 7, 7)).astype(np.uint8)
    light = np.maximum(signal, 0)
    weight = good / (noise**2 + 0.7 * light + (0.05 * light) ** 2)
    flux, information = phase_fluxes(signal, noise, good, phase, value, 0.7, 0.05, 4)
    for k in range(4):
        own = weight * (phase == k)
        np.testing.assert_allclose(information[:, k], (own * value**2).sum((1, 2)), rtol=1e-5)
        np.testing.assert_allclose(
            flux[:, k] * information[:, k], (own * value * signal).sum((1, 2)), rtol=1e-5
        )

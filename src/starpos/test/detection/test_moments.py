# SPDX-License-Identifier: Apache-2.0
"""Windowed moments of compiled code against their plain sums."""

import numpy as np
import pytest

from starpos.detection._moments import centroids, clip_widths, window_moments


def plain(signal, left, top, window):
    """Moments of images (N, S, S), summed pixel by pixel."""
    inverse = np.linalg.inv(window)
    grid = np.arange(signal.shape[1])
    d = np.stack(
        np.broadcast_arrays((left[:, None] + grid)[:, None, :], (top[:, None] + grid)[:, :, None]), -1
    )
    light = signal * np.exp(-0.5 * np.einsum("nyxi,nij,nyxj->nyx", d, inverse, d))
    mass = light.sum((1, 2))
    mean = np.einsum("nyx,nyxi->ni", light, d) / mass[:, None]
    square = np.einsum("nyx,nyxi,nyxj->nij", light, d, d) / mass[:, None, None]
    return mass, mean, square - mean[:, :, None] * mean[:, None, :]


@pytest.mark.parametrize(("size", "off_px"), [(5, 0.4), (25, 0.4), (25, 30.0), (121, 0.4)])
def test_moments_are_those_of_plain_sums(size, off_px, rng):
    """A window may be far narrower than its stamp, and its middle off it."""
    n = 20
    signal = rng.uniform(1, 2, (n, size, size)).astype(np.float32)
    left, top = -(size // 2) + rng.uniform(-off_px, off_px, (2, n))
    root = rng.normal(0, 1, (n, 2, 2))
    window = root @ root.transpose(0, 2, 1) + (1 + off_px**2) * np.eye(2)
    for found, expected in zip(
        window_moments(signal, left, top, window), plain(signal, left, top, window), strict=True
    ):
        # what lies beyond five widths of a window is left out
        np.testing.assert_allclose(found, expected, rtol=2e-5, atol=2e-5)


def test_without_light_there_is_no_place():
    signal = -np.ones((1, 7, 7), np.float32)
    mass, mean, shape = window_moments(signal, np.array([-3.0]), np.array([-3.0]), np.eye(2)[None])
    assert mass[0] < 0
    assert np.isnan(mean).all() and np.isnan(shape).all()


def images(rng, n, size=13):
    """Stars (N, S, S) near the middles of their images, the first without light, and a shape each."""
    grid = np.arange(size) - size // 2
    x, y = rng.uniform(-2.5, 2.5, (2, n, 1))
    signal = np.exp(-0.3 * (grid - y) ** 2)[:, :, None] * np.exp(-0.2 * (grid - x) ** 2)[:, None, :]
    signal[0] = -1
    root = rng.normal(0, 0.3, (n, 2, 2))
    return signal.astype(np.float32), root @ root.transpose(0, 2, 1) + 2 * np.eye(2)


@pytest.mark.parametrize("rounds", [1, 4])
def test_places_are_those_of_means_through_windows(rounds, rng):
    n, half = 20, 6
    signal, shape = images(rng, n)
    window = clip_widths(shape, 2.5, np.inf, 1.0)
    gain = np.eye(2) + shape @ np.linalg.inv(window)
    column, row = rng.integers(0, 100, (2, n))
    x, y = column.astype(float), row.astype(float)
    for _ in range(rounds):
        mean = plain(signal, column - half - x, row - half - y, window)[1]
        step = np.clip((gain @ mean[..., None])[..., 0], -1, 1)
        step[0] = 0
        x, y = np.clip(x + step[:, 0], column - 2, column + 2), np.clip(y + step[:, 1], row - 2, row + 2)
    found = centroids(signal, column, row, shape, 2.5, rounds, 2.0)
    np.testing.assert_allclose(found, (x, y), rtol=0, atol=1e-9)
    alone = centroids(signal[1:2], column[1:2], row[1:2], shape[1:2], 2.5, rounds, 2.0)
    np.testing.assert_allclose(np.ravel(alone), (x[1], y[1]), rtol=0, atol=1e-9)


def test_a_window_for_each_image_is_needed(rng):
    signal, window = images(rng, 4)
    place = np.zeros(4, int)
    with pytest.raises(ValueError, match="windows"):
        centroids(signal, place, place, window[:2], 1.0, 3, 2.0)
    with pytest.raises(ValueError, match="places"):
        window_moments(signal, np.zeros(3), np.zeros(4), window)

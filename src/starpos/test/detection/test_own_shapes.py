# SPDX-License-Identifier: Apache-2.0
"""Shapes of stars through windows that follow them, of compiled code, against their plain forms."""

import numpy as np
import pytest

from starpos.detection._moments import (
    centroids,
    clip_widths,
    own_shapes,
    window_moments,
    without_window,
)


def stars(rng, n, size=13):
    """Images (N, S, S) of stars of many shapes in noise, near their middles; some are nothing, or in a hole."""
    grid = np.arange(size) - size // 2
    x, y = rng.uniform(-1, 1, (2, n, 1))
    wide, high = rng.uniform(0.6, 4, (2, n, 1))
    signal = (
        np.exp(-0.5 * ((grid - y) / high) ** 2)[:, :, None]
        * np.exp(-0.5 * ((grid - x) / wide) ** 2)[:, None, :]
    )
    kind = rng.integers(0, 5, (n, 1, 1))
    signal = np.where(kind == 0, 0, signal) - 0.2 * (kind == 1) + rng.normal(0, 0.01, (n, size, size))
    return signal.astype(np.float32)


def plain_own_shapes(signal, first, narrowest_window, narrowest, widest):
    """Shapes (N, 2, 2) and squared widths (N, 2) by whole arrays, in 3 rounds; in all but the first of 2 centrings."""
    n, half = len(signal), signal.shape[1] // 2
    middle, shape = np.full(n, half), np.eye(2)[None].repeat(n, 0) * first
    for centrings in (0, 2, 2):
        window = clip_widths(shape, narrowest_window, np.inf, 1.0)
        x, y = centroids(signal, middle, middle, shape, narrowest_window, centrings, 2.0)
        own = np.nan_to_num(without_window(window_moments(signal, -x, -y, window)[2], window))
        values, vectors = np.linalg.eigh(own)
        values = np.where(values > 0, np.clip(values, narrowest, widest), widest)
        shape = (vectors * values[:, None, :]) @ vectors.transpose(0, 2, 1)
    return shape, values


def test_own_shapes_are_those_of_windows_that_follow_them(rng):
    signal = stars(rng, 60)
    found, plain = (
        own_shapes(signal, 9.0, 1.2, 0.2, 36.0, 3, 2, 2.0),
        plain_own_shapes(signal, 9.0, 1.2, 0.2, 36.0),
    )
    for one, other in zip(found, plain, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-7, atol=1e-9)


def test_darkness_has_the_widest_shape():
    dark = np.zeros((3, 9, 9), np.float32)
    np.testing.assert_array_equal(own_shapes(dark, 4.0, 1.2, 0.2, 16.0, 3, 2, 2.0)[1], 16.0)
    with pytest.raises(ValueError, match="square"):
        own_shapes(dark[:, :8].copy(), 4.0, 1.2, 0.2, 16.0, 3, 2, 2.0)

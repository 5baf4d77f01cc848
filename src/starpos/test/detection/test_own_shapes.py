# SPDX-License-Identifier: Apache-2.0
"""Shapes of stars through windows that follow them, of compiled code, against their plain forms."""

import numpy as np
import pytest

from starpos.detection._moments import (
    centroids,
    clip_widths,
    invert_shapes,
    own_shapes,
    typical_shape,
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
        x, y = centroids(
            signal, middle, middle, window, np.eye(2) + shape @ invert_shapes(window), centrings, 2.0
        )
        own = np.nan_to_num(without_window(window_moments(signal, -x, -y, window)[2], window))
        values, vectors = np.linalg.eigh(own)
        values = np.where(values > 0, np.clip(values, narrowest, widest), widest)
        shape = (vectors * values[:, None, :]) @ vectors.transpose(0, 2, 1)
    return shape, values


def plain_settled(signal, first, narrowest_window, narrowest, widest):
    """The typical shape by medians over whole arrays, or None."""
    half = signal.shape[1] // 2
    x, y = np.full((2, len(signal)), float(half))
    window, shape = np.eye(2) * first, None
    for _ in range(12):
        _, step, seen = window_moments(signal, -x, -y, window[None])
        usable = (np.abs(step).max(1) < 1.5) & (np.linalg.eigvalsh(np.nan_to_num(seen))[:, 0] > 0.1)
        if not usable.any():
            break
        of_seen, of_window = invert_shapes(np.stack([np.median(seen[usable], axis=0), window]))
        own = clip_widths((of_seen - of_window)[None], 1 / widest, 1 / narrowest, -1.0)[0]
        step = np.where(usable[:, None], step @ (np.eye(2) + own @ of_window).T, 0)
        x, y = x + np.clip(step[:, 0], -1, 1), y + np.clip(step[:, 1], -1, 1)
        change = np.inf if shape is None else np.abs(own - shape).max() / own.max()
        shape, window = own, clip_widths(own[None], narrowest_window, np.inf, 1.0)[0]
        if change < 1e-3:
            break
    return shape


def test_own_shapes_are_those_of_windows_that_follow_them(rng):
    signal = stars(rng, 60)
    found, plain = (
        own_shapes(signal, 9.0, 1.2, 0.2, 36.0, 3, 2, 2.0),
        plain_own_shapes(signal, 9.0, 1.2, 0.2, 36.0),
    )
    for one, other in zip(found, plain, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize("first", [2.25, 9.0])
@pytest.mark.parametrize("n", [1, 2, 30])
def test_the_typical_shape_is_that_of_medians(first, n, rng):
    for _ in range(20):
        signal = stars(rng, n)
        found = typical_shape(signal, first, 1.2, 0.2, 36.0, 12, 1.5, 0.1, 1e-3)
        plain = plain_settled(signal, first, 1.2, 0.2, 36.0)
        assert (found is None) == (plain is None)
        if plain is not None:
            np.testing.assert_allclose(found, plain, rtol=1e-7)


def test_darkness_has_no_typical_shape_and_the_widest_of_its_own():
    dark = np.zeros((3, 9, 9), np.float32)
    assert typical_shape(dark, 4.0, 1.2, 0.2, 16.0, 12, 1.5, 0.1, 1e-3) is None
    assert typical_shape(dark[:0], 4.0, 1.2, 0.2, 16.0, 12, 1.5, 0.1, 1e-3) is None
    np.testing.assert_array_equal(own_shapes(dark, 4.0, 1.2, 0.2, 16.0, 3, 2, 2.0)[1], 16.0)
    with pytest.raises(ValueError, match="square"):
        typical_shape(dark[:, :8].copy(), 4.0, 1.2, 0.2, 16.0, 12, 1.5, 0.1, 1e-3)
    with pytest.raises(ValueError, match="square"):
        own_shapes(dark[:, :8].copy(), 4.0, 1.2, 0.2, 16.0, 3, 2, 2.0)

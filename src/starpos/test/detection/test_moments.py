# SPDX-License-Identifier: Apache-2.0
"""Windowed moments of the compiled core beside their plain sums."""

import numpy as np
import pytest

from starpos.core.moments import windowed


def plain(signal, left, top, inverse):
    """Moments of images (N, S, S), summed pixel by pixel."""
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
    """A window far narrower than its stamp, or whose middle is off it, keeps its digits too."""
    n = 20
    signal = rng.uniform(1, 2, (n, size, size)).astype(np.float32)
    left, top = -(size // 2) + rng.uniform(-off_px, off_px, (2, n))
    root = rng.normal(0, 1, (n, 2, 2))
    inverse = np.linalg.inv(root @ root.transpose(0, 2, 1) + (1 + off_px**2) * np.eye(2))
    for found, expected in zip(
        windowed(signal, left, top, inverse), plain(signal, left, top, inverse), strict=True
    ):
        np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9)


def test_without_light_there_is_no_place():
    signal = -np.ones((1, 7, 7), np.float32)
    mass, mean, shape = windowed(signal, np.array([-3.0]), np.array([-3.0]), np.eye(2)[None])
    assert mass[0] < 0
    assert np.isnan(mean).all() and np.isnan(shape).all()

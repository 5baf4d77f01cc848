# SPDX-License-Identifier: Apache-2.0
"""Closed forms of covariances against a library's."""

import numpy as np
import pytest

from starpos.detection._moments import (
    clip_widths,
    relative_widths,
    squared_widths,
    without_window,
)

N = 30


@pytest.fixture
def shapes(rng):
    """Covariances of stars and windows (2, N, 2, 2), the first round."""
    root = rng.normal(0, 1, (2, N, 2, 2))
    out = root @ root.transpose(0, 1, 3, 2) + 0.2 * np.eye(2)
    out[:, 0] = 2 * np.eye(2)
    return out


def test_limits_and_powers_are_those_of_eigenvalues(shapes):
    values, vectors = np.linalg.eigh(shapes[0])
    for least, most, exponent in ((1.0, np.inf, 1.0), (0.25, 6.0, -0.5), (0.0, 0.5, 2.0)):
        expected = (vectors * np.clip(values, least, most)[:, None] ** exponent) @ vectors.transpose(0, 2, 1)
        np.testing.assert_allclose(
            clip_widths(shapes[0], least, most, exponent), expected, rtol=1e-9, atol=1e-12
        )


def test_squared_widths_are_those_of_a_library(shapes):
    np.testing.assert_allclose(squared_widths(shapes[0]), np.linalg.eigvalsh(shapes[0]), rtol=1e-9)


@pytest.mark.parametrize("windows", [1, N])
def test_a_star_through_a_window_is_told_from_its_image(windows, shapes):
    shape, window = shapes[0], shapes[1, -windows:]
    seen = np.linalg.inv(np.linalg.inv(shape) + np.linalg.inv(window))
    np.testing.assert_allclose(without_window(seen, window), shape, rtol=1e-7, atol=1e-9)


def test_an_image_that_no_star_has_is_told(shapes):
    window = np.eye(2)[None]
    seen = np.stack([np.full((2, 2), np.nan), np.zeros((2, 2)), np.eye(2), 0.5 * np.eye(2)])
    found = without_window(seen, window)
    assert np.isnan(found[:3]).all()
    np.testing.assert_allclose(found[3], np.eye(2))
    np.testing.assert_array_equal(relative_widths(seen[:1], window, window), [[0, 0]])


def test_relative_widths_are_generalised_eigenvalues(shapes):
    seen, shape = shapes
    window = 3 * np.eye(2)[None]
    expected = np.linalg.inv(np.linalg.inv(shape) + np.linalg.inv(window))
    root = np.linalg.inv(np.linalg.cholesky(expected))
    values = np.linalg.eigvalsh(root @ seen @ root.transpose(0, 2, 1))
    np.testing.assert_allclose(relative_widths(seen, shape, window), values, rtol=1e-9, atol=1e-12)


def test_as_many_matrices_are_needed(shapes):
    with pytest.raises(ValueError, match="needed"):
        without_window(shapes[0], shapes[1, :2])
    with pytest.raises(ValueError, match="2 x 2"):
        squared_widths(np.ones((3, 2, 3)))
    assert clip_widths(np.zeros((0, 2, 2)), 0.0, 1.0, 1.0).shape == (0, 2, 2)

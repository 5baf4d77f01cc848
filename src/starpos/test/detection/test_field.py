# SPDX-License-Identifier: Apache-2.0
"""A PSF at places of the field, by compiled code, against its plain form; the variation that its stars show."""

import numpy as np
import pytest

from starpos.detection._psf import monomials, psf_at, shapes_of

BOX = np.array([[10.0, 20.0], [410.0, 20.5]])


def plain_monomials(x, y, box):
    place = 2 * (np.stack([x, y], -1) - box[0]) / np.maximum(box[1] - box[0], 1) - 1
    p, q = np.nan_to_num(np.clip(place, -1, 1)).T
    return np.stack([np.ones_like(p), p, q, p * p - 1 / 3, p * q, q * q - 1 / 3], -1)


def plain_power(widths, exponent):
    values, vectors = np.linalg.eigh(widths)
    return (vectors * np.clip(values, 0.25, 6.0)[:, None] ** exponent) @ vectors.transpose(0, 2, 1)


@pytest.mark.parametrize("varied", [1, 6])
@pytest.mark.parametrize("wide", [1, 6])
def test_a_psf_at_places_is_the_sum_of_its_monomials(wide, varied, rng):
    x, y = np.append(rng.uniform(0, 420, 9), np.nan), np.append(rng.uniform(19, 22, 9), np.inf)
    axes, series = rng.normal(0, 1, (2, 2)), rng.normal(0, 1, (varied, 3, 4))
    widths = rng.normal(0, 0.3, (wide, 2, 2))
    widths = np.eye(2) * (np.arange(wide) == 0)[:, None, None] + widths + widths.transpose(0, 2, 1)
    field = plain_monomials(x, y, BOX)
    np.testing.assert_allclose(monomials(x, y, BOX), field, rtol=1e-13, atol=1e-13)
    axes_there = plain_power(np.tensordot(field[:, :wide], widths, 1), -0.5) @ axes
    axes_there = axes_there if wide > 1 else axes[None]
    series_there = series if varied == 1 else np.tensordot(field, series, 1)
    found_axes, found_series = psf_at(x, y, BOX, axes, widths, series, 0.25, 6.0)
    np.testing.assert_allclose(found_axes, axes_there, rtol=1e-11, atol=1e-12)
    np.testing.assert_allclose(found_series, series_there, rtol=1e-11, atol=1e-12)
    plain = np.linalg.inv(axes_there.transpose(0, 2, 1) @ axes_there)
    np.testing.assert_allclose(shapes_of(axes_there), plain, rtol=1e-9)


def test_what_is_no_psf_is_refused():
    x, one = np.zeros(3), np.ones((1, 2, 2))
    with pytest.raises(ValueError, match="as many"):
        monomials(x, x[:2], BOX)
    with pytest.raises(ValueError, match="1 or 6"):
        psf_at(x, x, BOX, np.eye(2), one.repeat(5, 0), one, 0.25, 6.0)
    with pytest.raises(ValueError, match="2 x 2"):
        psf_at(x, x, BOX, np.eye(3), one, one, 0.25, 6.0)

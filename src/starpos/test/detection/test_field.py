# SPDX-License-Identifier: Apache-2.0
"""A PSF at places of the field, and which of its terms are taken, of compiled code, against their plain forms."""

import numpy as np
import pytest

from starpos.detection._learn import choose_terms, fit_field_robustly
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


def plain_chosen(normal, right, candidates, price):
    found, taken, most = np.zeros(len(right)), np.zeros(len(right), bool), 0.0
    for candidate in candidates:
        index = np.flatnonzero(taken | candidate)
        solution = np.linalg.solve(normal[np.ix_(index, index)], right[index])
        gain = right[index] @ solution - price[index].sum()
        if gain > most:
            most, taken = gain, taken | candidate
            found = np.zeros(len(right))
            found[index] = solution
    return found


def test_terms_are_taken_that_are_worth_their_price(rng):
    taken = set()
    for _ in range(50):
        design, candidates = rng.normal(0, 1, (90, 30)), rng.random((6, 30)) < 0.3
        signal = design @ (rng.normal(0, 1, 30) * (rng.random(30) < 0.2)) + rng.normal(0, 3, 90)
        normal, right, price = design.T @ design, design.T @ signal, rng.uniform(0, 9, 30)
        plain = plain_chosen(normal, right, candidates, price)
        np.testing.assert_allclose(
            choose_terms(normal, right, candidates.view(np.uint8), price), plain, rtol=1e-9
        )
        taken.add(np.count_nonzero(plain))
    assert len(taken) > 3


def test_terms_that_nothing_tells_are_not_taken():
    normal, candidates = np.zeros((2, 2)), np.ones((1, 2), np.uint8)
    assert not choose_terms(normal, np.ones(2), candidates, np.ones(2)).any()
    assert not choose_terms(normal + np.nan, np.ones(2), candidates, np.ones(2)).any()
    with pytest.raises(ValueError, match="2 are needed"):
        choose_terms(normal, np.ones(2), candidates, np.ones(3))


def test_rows_that_disagree_are_left_out(rng):
    x, y = rng.uniform(0, 420, 40), rng.uniform(0, 300, 40)
    field = plain_monomials(x, y, np.array([[0.0, 0.0], [420.0, 300.0]]))
    true, weight = rng.normal(0, 1, (6, 4)), rng.uniform(50, 100, 40)
    own = field @ true + rng.normal(0, 1, (40, 4)) / np.sqrt(weight)[:, None]
    own[3] += 40
    fitted, before, after, count = fit_field_robustly(field, own, weight, 6.0, 12, 4)
    keep = np.arange(40) != 3
    root = np.sqrt(weight[keep])[:, None]
    plain = np.linalg.lstsq(field[keep] * root, own[keep] * root, rcond=None)[0]
    np.testing.assert_allclose(fitted, plain, rtol=1e-8, atol=1e-9)
    assert count == 39
    assert after == pytest.approx(((own[keep] - field[keep] @ plain) ** 2 * root**2).sum(), rel=1e-9)
    mean = np.average(own[keep], axis=0, weights=weight[keep])
    assert before == pytest.approx(((own[keep] - mean) ** 2 * root**2).sum(), rel=1e-9)
    assert fit_field_robustly(field[:11], own[:11], weight[:11], 6.0, 12, 4) is None

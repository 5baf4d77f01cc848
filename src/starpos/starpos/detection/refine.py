# SPDX-License-Identifier: Apache-2.0
"""Refine a PSF by stars that were fitted with it, and find whether it varies over the field."""

import math
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from starpos.core.marginal import chosen, marginal
from starpos.core.order import median
from starpos.detection.psf import MONOMIALS, Psf, power

# A variation over the field needs at least so many stars,
PLACES = 12
# and widths that vary over the field must be better than constant ones by this F.
SIGNIFICANT = 4.0
# Prior of each coefficient, 1 sigma.
LIKELY = 0.3
# So much must each further coefficient lower chi-square: the Akaike criterion, and twice that for coefficients whose
# errors move all stars of a frame, or of a part of it, together.
WORTH, DEAR = 2.0, 4.0
# Order of the odd terms.
COMA = 3
COMA_ORDERS = np.array([(i, COMA - i) for i in range(COMA + 1)])
# Highest order of the even terms that may vary over the field.
FIELD_ORDER = 4


def widened(psf: Psf, x: np.ndarray, y: np.ndarray, ratio: np.ndarray, weight: np.ndarray) -> Psf:
    """The Psf with squared widths that vary over the field as those of N stars do; psf itself if they do not.

    psf     the same everywhere
    x, y    (N,) px
    ratio   (N, 2, 2): the stars' covariances along the axes of psf
    weight  (N,) inverse variances of ratio, in any unit
    """
    if len(x) < PLACES:
        return psf
    field, own, keep = psf.monomials(x, y), ratio.reshape(-1, 4), np.ones(len(x), bool)
    for _ in range(4):
        scale = np.sqrt(weight * keep)[:, None]
        fitted = np.linalg.lstsq(field * scale, own * scale, rcond=None)[0]
        off = np.sqrt(weight) * np.abs(own - field @ fitted).max(1)
        # pairs are wide but tell nothing of the optics
        kept, keep = keep, off < 6 * median(off)
        if keep.sum() < PLACES:
            return psf
        if np.array_equal(keep, kept):
            break
    used = (weight * keep)[:, None]
    mean = (used * own).sum(0) / used.sum()
    before, after = ((used * (own - model) ** 2).sum() for model in (mean, field @ fitted))
    if (before - after) / (MONOMIALS - 1) < SIGNIFICANT * after / (keep.sum() - MONOMIALS):
        return psf
    return psf.with_widths(fitted.reshape(-1, 2, 2))


@dataclass(frozen=True, eq=False)
class Terms:
    """Terms of the series, and the sets of coefficients that are tried one after the other.

    orders      (T, 2): (i, j) of each term, without (0, 0), which is always there
    candidates  (C, T, K) bool: sets of coefficients, of T terms in K monomials of the field; each is added to those
                accepted before
    price       (T, K): what each coefficient must lower chi-square by
    """

    orders: np.ndarray
    candidates: np.ndarray
    price: np.ndarray


def even_terms(psf: Psf, highest: int) -> Terms:
    """Terms of even order, up to `highest` across the trail and, for a long star, up to twice that along it."""
    orders = _even_orders(highest)
    rank = _rank(psf, *orders.T)
    orders, rank = orders[rank <= highest], rank[rank <= highest]
    steps = np.arange(2, highest + 1, 2)
    return Terms(orders, (rank <= steps[:, None])[..., None], np.full((len(orders), 1), WORTH))


@cache
def _even_orders(highest: int) -> np.ndarray:
    """All i, j (T, 2) of even terms that can be of use, without (0, 0)."""
    grid = [(i, j) for i in range(2 * highest + 1) for j in range(highest + 1) if (i + j) % 2 == 0]
    return np.array(grid[1:])


def all_terms(psf: Psf, highest: int, count: int) -> Terms:
    """The even terms, then coma, then variations over the field if there are enough stars, `count`."""
    even = even_terms(psf, highest)
    orders = np.concatenate([even.orders, COMA_ORDERS])
    first = np.arange(MONOMIALS if count >= PLACES else 1) == 0
    steps = np.concatenate(
        [even.candidates[..., 0], np.zeros((len(even.candidates), len(COMA_ORDERS)), bool)], 1
    )
    width, coma = orders.sum(1) == 2, orders.sum(1) == COMA
    shape = (_rank(psf, *orders.T) <= FIELD_ORDER) & ~width & ~coma
    everywhere = [terms[:, None] & first for terms in (*steps, coma)]
    field = [terms[:, None] & ~first for terms in (width, coma, shape)] if len(first) > 1 else []
    return Terms(orders, np.array(everywhere + field), np.where(coma[:, None] | ~first, DEAR, WORTH))


def _rank(psf: Psf, i: np.ndarray, j: np.ndarray) -> np.ndarray:
    """The order that terms i, j (T,) count as: along the trail of a long star orders count less, down to half."""
    across, along = (math.hypot(*axis) for axis in psf.axes[::-1].tolist())
    return i / min(max(across / along, 1), 2) + j


def refine(
    psf: Psf,
    x: np.ndarray,
    y: np.ndarray,
    left: np.ndarray,
    top: np.ndarray,
    brightness: np.ndarray,
    weight: np.ndarray,
    phase: np.ndarray,
    phases: int,
    terms: Terms,
) -> Psf:
    """The Psf whose series fits N stars best, by weighted linear least squares with free positions and gains.

    x, y        (N,) px: the stars' places
    left, top   (N,) px: of each stamp's first column and row from its star's centre
    brightness  (N, S, S): the pixels over their stars' fluxes and gains
    weight      (N, S, S): inverse variances of brightness; 0 for a pixel that is not used
    phase       (N, S, S): the pixels' numbers in the mosaic, of so many phases
    terms       the terms that are tried; they are taken if they are worth their price
    """
    local = psf.at(x, y)
    normal, right = marginal(
        local.axes, local.series, left, top, brightness, weight, phase, phases, terms.orders.astype(np.int32)
    )
    count, places = terms.candidates.shape[1:]
    field = psf.monomials(x, y)[:, :places]
    each = (field[:, :, None] * field[:, None]).reshape(len(x), -1).T @ normal.reshape(len(x), -1)
    normal = each.reshape(places, places, count, count).transpose(2, 0, 3, 1).reshape(count * places, -1)
    right = (right.T @ field).ravel()
    candidates = terms.candidates.reshape(-1, len(right)).view(np.uint8)
    found = chosen(normal + np.eye(len(right)) / LIKELY**2, right, candidates, terms.price.ravel())
    if not np.all(np.isfinite(found)):
        return psf
    found = found.reshape(count, places)
    if places > 1:
        psf, found = _absorbed(psf, field, terms.orders, found)
    used = np.any(found, axis=1)
    i, j = np.concatenate([[(0, 0)], terms.orders[used]]).T
    series = np.zeros((places if np.any(found[:, 1:]) else 1, i.max() + 1, j.max() + 1))
    # unit flux: the other terms integrate to zero
    series[0, 0, 0] = 1
    series[:, i[1:], j[1:]] = found[used, : len(series)].T
    return replace(psf, series=series)


def _absorbed(psf: Psf, field: np.ndarray, orders: np.ndarray, found: np.ndarray) -> tuple[Psf, np.ndarray]:
    """Psf and coefficients with the field's second-order terms moved into the widths, which hold any amount of them."""
    uu, uv, vv = (np.flatnonzero((orders == term).all(1))[0] for term in ((2, 0), (1, 1), (0, 2)))
    if not np.any(found[[uu, uv, vv], 1:]):
        return psf, found
    a, b, c = found[[uu, uv, vv], 1:] @ field[:, 1:].T
    change = np.stack([1 + np.sqrt(2) * a, b, b, 1 + np.sqrt(2) * c], -1).reshape(-1, 2, 2)
    root = power(np.tensordot(field[:, : len(psf.widths)], psf.widths, 1), 0.5)
    widths = np.linalg.lstsq(field, (root @ change @ root).reshape(-1, 4), rcond=None)[0]
    found = found.copy()
    found[[uu, uv, vv], 1:] = 0
    return psf.with_widths(widths.reshape(-1, 2, 2)), found

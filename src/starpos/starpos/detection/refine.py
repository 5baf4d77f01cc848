# SPDX-License-Identifier: Apache-2.0
"""A better PSF from stars fitted with the last one, and whether it differs from place to place."""

from dataclasses import dataclass, replace

import numpy as np

from starpos.detection.psf import MONOMIALS, Psf, power

PLACES = 12  # stars at least that may tell the field's corners apart
SIGNIFICANT = 4.0  # F of widths that go with the field against the same everywhere
LIKELY = 0.3  # 1 sigma of a coefficient of which no star tells
# By how much each further coefficient must lower chi-square: Akaike's price, and twice that for those which move all
# stars of a frame, or of a part of it, by as much as they err
WORTH, DEAR = 2.0, 4.0
COMA = 3  # order of the odd terms
FIELD_ORDER = 4  # of the even terms that may go with the field


def widened(psf, x, y, ratio, weight) -> Psf:
    """The Psf whose squared widths go with the field as those of N stars do, if they do.

    x, y    (N,) px
    ratio   (N, 2, 2): the stars' covariances along the axes of psf, which is the same everywhere
    weight  (N,) inverse variances of ratio, in any unit
    """
    if len(x) < PLACES:
        return psf
    field, own, keep = psf.monomials(x, y), ratio.reshape(-1, 4), np.ones(len(x), bool)
    for _ in range(4):
        scale = np.sqrt(weight * keep)[:, None]
        fitted = np.linalg.lstsq(field * scale, own * scale, rcond=None)[0]
        off = np.sqrt(weight) * np.abs(own - field @ fitted).max(1)
        keep = off < 6 * np.median(off)  # pairs are wide, and no measure of the optics
        if keep.sum() < PLACES:
            return psf
    used = (weight * keep)[:, None]
    mean = (used * own).sum(0) / used.sum()
    before, after = ((used * (own - model) ** 2).sum() for model in (mean, field @ fitted))
    if (before - after) / (MONOMIALS - 1) < SIGNIFICANT * after / (keep.sum() - MONOMIALS):
        return psf
    return psf.with_widths(fitted.reshape(-1, 2, 2))


@dataclass(frozen=True, eq=False)
class Terms:
    """Terms of the series, and in which sets of them a better PSF is looked for.

    orders      (T, 2): (i, j) of each, without the (0, 0) that all have
    candidates  (C, T, K) bool: coefficients of the terms in the field's monomials, each set tried besides the best before
    price       (T, K): what each coefficient must be worth
    """

    orders: np.ndarray
    candidates: np.ndarray
    price: np.ndarray


def even_terms(psf, highest) -> Terms:
    """Terms of even order, `highest` across the trail; along it more, up to twice as many, as the star is longer."""
    grid = [(i, j) for i in range(2 * highest + 1) for j in range(highest + 1) if (i + j) % 2 == 0]
    orders = np.array([term for term in grid if 0 < _rank(psf, *term) <= highest])
    steps = np.arange(2, highest + 1, 2)
    return Terms(
        orders, (_rank(psf, *orders.T) <= steps[:, None])[..., None], np.full((len(orders), 1), WORTH)
    )


def all_terms(psf, highest, count) -> Terms:
    """Those, then coma's, and then what goes with the field, if `count` stars are enough to tell."""
    even = even_terms(psf, highest)
    odd = np.array([(i, COMA - i) for i in range(COMA + 1)])
    orders = np.concatenate([even.orders, odd])
    first = np.arange(MONOMIALS if count >= PLACES else 1) == 0
    steps = np.pad(even.candidates[..., 0], ((0, 0), (0, len(odd))))
    width, coma = orders.sum(1) == 2, orders.sum(1) == COMA
    shape = (_rank(psf, *orders.T) <= FIELD_ORDER) & ~width & ~coma
    everywhere = [terms[:, None] & first for terms in (*steps, coma)]
    field = [terms[:, None] & ~first for terms in (width, coma, shape)] if len(first) > 1 else []
    return Terms(orders, np.array(everywhere + field), np.where(coma[:, None] | ~first, DEAR, WORTH))


def _rank(psf, i, j):
    """The order of terms i, j (T,) across the trail."""
    long, short = 1 / np.linalg.norm(psf.axes, axis=1)
    return i / float(np.clip(long / short, 1, 2)) + j


def refine(psf, x, y, dx, dy, brightness, weight, phase, terms) -> Psf:
    """The Psf whose series fits N stars best, by weighted linear least squares; their positions and gains may follow.

    x, y        (N,) px: the stars' places
    dx, dy      (N, S, S) px, broadcastable: offsets of S x S pixels from their stars' centres
    brightness  (N, S, S): those pixels over their stars' fluxes and gains
    weight      (N, S, S): inverse variances of brightness; 0: not used
    phase       (N, S, S): which of the mosaic's gains is theirs
    terms       Terms, of which as many are taken as are worth their price
    """
    normal, right = _marginal(psf.at(x, y), dx, dy, brightness, weight, phase, terms.orders)
    count, places = terms.candidates.shape[1:]
    field = psf.monomials(x, y)[:, :places]
    normal = np.einsum("nab,nk,nl->akbl", normal, field, field, optimize=True).reshape(count * places, -1)
    right = np.einsum("na,nk->ak", right, field).ravel()
    candidates = terms.candidates.reshape(-1, len(right))
    found = _chosen(normal + np.eye(len(right)) / LIKELY**2, right, candidates, terms.price.ravel())
    if not np.all(np.isfinite(found)):
        return psf
    found = found.reshape(count, places)
    if places > 1:
        psf, found = _absorbed(psf, field, terms.orders, found)
    used = np.any(found, axis=1)
    i, j = np.concatenate([[(0, 0)], terms.orders[used]]).T
    series = np.zeros((places if np.any(found[:, 1:]) else 1, i.max() + 1, j.max() + 1))
    series[0, 0, 0] = 1  # unit flux: the other terms integrate to zero
    series[:, i[1:], j[1:]] = found[used, : len(series)].T
    return replace(psf, series=series)


def _marginal(local, dx, dy, brightness, weight, phase, orders):
    """(N, T, T) and (N, T): the normal equations of each star for the terms, whatever its position and gains are."""
    n, count = len(brightness), len(orders)
    weight = weight.reshape(n, 1, -1)
    value, by_x, by_y = (a.reshape(n, 1, -1) for a in local.evaluate(dx, dy))
    mean = local.terms(dx, dy, np.zeros((1, 2), int))
    gains = value * (phase.reshape(n, 1, -1) == np.arange(phase.max() + 1)[:, None])
    design = np.concatenate([local.terms(dx, dy, orders), gains, by_x, by_y], axis=1)
    weighted = design * weight
    normal = (weighted @ design.transpose(0, 2, 1)).astype(np.float64)
    left = brightness.reshape(n, 1, -1) - mean
    right = np.einsum("ntp,np->nt", weighted, left[:, 0]).astype(np.float64)
    free = normal[:, count:, count:]
    free = free + np.eye(free.shape[1]) * (1e-9 * np.trace(free, axis1=1, axis2=2)[:, None, None] + 1e-30)
    share = normal[:, :count, count:] @ np.linalg.inv(free)
    normal = normal[:, :count, :count] - share @ normal[:, count:, :count]
    return normal, right[:, :count] - np.einsum("ntk,nk->nt", share, right[:, count:])


def _chosen(normal, right, candidates, price):
    """The coefficients with which chi-square and their price are lowest; 0 where not worth it."""
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


def _absorbed(psf, field, orders, found):
    """What the terms of second order make of the widths over the field becomes the axes', which hold any amount."""
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

# SPDX-License-Identifier: Apache-2.0
"""Refine a PSF by stars that were fitted with it, and find whether it varies over the field."""

import math
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np

from starpos.detection._field import agreed, over_field
from starpos.detection._marginal import chosen, marginal
from starpos.detection.psf import MONOMIALS, Psf, power

# Minimum number of stars for a variation over the field,
PLACES = 12
# and widths that vary over the field must be better than constant ones by this F.
SIGNIFICANT = 4.0
# and maximum distance of any of these stars from it, over the median distance.
OUTLYING = 6.0
# Prior of each coefficient, 1 sigma.
LIKELY = 0.3
# So much must each further coefficient lower chi-square: the Akaike criterion, and twice that for coefficients whose
# errors move all stars of a frame, or of a part of it, together.
WORTH, DEAR = 2.0, 4.0
# Order of the odd terms.
COMA = 3
COMA_ORDERS = np.array([(i, COMA - i) for i in range(COMA + 1)], np.int32)
# Highest order of the even terms that may vary over the field.
FIELD_ORDER = 4
# Steps in which stars are longer than wide.
STEPS = 32


def widened(psf: Psf, x: np.ndarray, y: np.ndarray, ratio: np.ndarray, weight: np.ndarray) -> Psf:
    """The Psf with squared widths that vary over the field as N stars' widths do; psf itself if they do not.

    psf     the same everywhere
    x, y    (N,) px
    ratio   (N, 2, 2): the stars' covariances along the axes of psf
    weight  (N,) inverse variances of ratio, in any unit
    """
    # pairs are wide but say nothing about the optics
    found = agreed(psf.monomials(x, y), ratio.reshape(-1, 4), weight, OUTLYING, PLACES, 4)
    if found is None:
        return psf
    fitted, before, after, count = found
    if (before - after) / (MONOMIALS - 1) < SIGNIFICANT * after / (count - MONOMIALS):
        return psf
    return psf.with_widths(fitted.reshape(-1, 2, 2))


@dataclass(frozen=True, eq=False)
class Terms:
    """Terms of the series, and the sets of coefficients that are tried one after the other.

    orders      (T, 2) int32: (i, j) of each term, without (0, 0), which is always there
    candidates  (C, T, K) bool: sets of coefficients, of T terms in K monomials of the field; each is added to those
                accepted before
    price       (T, K): what each coefficient must lower chi-square by
    """

    orders: np.ndarray
    candidates: np.ndarray
    price: np.ndarray

    @cached_property
    def second(self) -> list[int]:
        """Rows of the terms (2, 0), (1, 1) and (0, 2)."""
        return [self.orders.tolist().index(term) for term in ([2, 0], [1, 1], [0, 2])]


def even_terms(psf: Psf, highest: int) -> Terms:
    """Terms of even order, up to `highest` across the trail and, for a long star, up to twice that along it."""
    return _even_terms(_lengthened(psf), highest)


def all_terms(psf: Psf, highest: int, count: int) -> Terms:
    """The even terms, then coma, then variations over the field if there are enough stars, `count`."""
    return _all_terms(_lengthened(psf), highest, count >= PLACES)


def _lengthened(psf: Psf) -> float:
    """How many times longer than wide a star is, from 1 to 2, in steps: the terms of each are made once."""
    across, along = (math.hypot(*axis) for axis in psf.axes[::-1].tolist())
    return round(STEPS * min(max(across / along, 1.0), 2.0)) / STEPS


def _rank(orders: np.ndarray, longer: float) -> np.ndarray:
    """The order that terms (T, 2) count as: along a trail they count less, by the ratio of its length to its width."""
    return orders[:, 0] / longer + orders[:, 1]


@lru_cache(maxsize=64)
def _even_terms(longer: float, highest: int) -> Terms:
    grid = [(i, j) for i in range(2 * highest + 1) for j in range(highest + 1) if (i + j) % 2 == 0]
    orders = np.array(grid[1:], np.int32)
    orders = orders[_rank(orders, longer) <= highest]
    steps = np.arange(2, highest + 1, 2)
    candidates = (_rank(orders, longer) <= steps[:, None])[..., None]
    return Terms(orders, candidates, np.full((len(orders), 1), WORTH))


@lru_cache(maxsize=64)
def _all_terms(longer: float, highest: int, varied: bool) -> Terms:
    even = _even_terms(longer, highest)
    orders = np.concatenate([even.orders, COMA_ORDERS])
    first = np.arange(MONOMIALS if varied else 1) == 0
    steps = np.concatenate(
        [even.candidates[..., 0], np.zeros((len(even.candidates), len(COMA_ORDERS)), bool)], 1
    )
    width, coma = orders.sum(1) == 2, orders.sum(1) == COMA
    shape = (_rank(orders, longer) <= FIELD_ORDER) & ~width & ~coma
    everywhere = [terms[:, None] & first for terms in (*steps, coma)]
    field = [terms[:, None] & ~first for terms in (width, coma, shape)] if varied else []
    return Terms(orders, np.array(everywhere + field), np.where(coma[:, None] | ~first, DEAR, WORTH))


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
    left, top   (N,) px: first column and row of a stamp, from the centre of the star
    brightness  (N, S, S): the pixels over their stars' fluxes and gains
    weight      (N, S, S): inverse variances of brightness; 0 for a pixel that is not used
    phase       (N, S, S): the pixels' phases in the mosaic, counted from 0; phases: their number
    terms       the terms that are tried; they are taken if they are worth their price
    """
    local = psf.at(x, y)
    normal, right = marginal(
        local.axes, local.series, left, top, brightness, weight, phase, phases, terms.orders
    )
    count, places = terms.candidates.shape[1:]
    field = psf.monomials(x, y)[:, :places]
    each = (field[:, :, None] * field[:, None]).reshape(len(x), -1).T @ normal.reshape(len(x), -1)
    normal = each.reshape(places, places, count, count).transpose(2, 0, 3, 1).reshape(count * places, -1)
    right = (right.T @ field).ravel()
    candidates = terms.candidates.reshape(-1, len(right)).view(np.uint8)
    normal.flat[:: len(right) + 1] += LIKELY**-2
    found = chosen(normal, right, candidates, terms.price.ravel())
    if not np.isfinite(found).all():
        return psf
    found = found.reshape(count, places)
    if places > 1:
        psf, found = _absorbed(psf, field, terms, found)
    used = found.any(1)
    i, j = np.concatenate([[(0, 0)], terms.orders[used]]).T
    series = np.zeros((places if found[:, 1:].any() else 1, i.max() + 1, j.max() + 1))
    # unit flux: the other terms integrate to zero
    series[0, 0, 0] = 1
    series[:, i[1:], j[1:]] = found[used, : len(series)].T
    return replace(psf, series=series)


def _absorbed(psf: Psf, field: np.ndarray, terms: Terms, found: np.ndarray) -> tuple[Psf, np.ndarray]:
    """Psf and coefficients with the field's second-order terms moved into the widths, which hold any amount of them."""
    varied = found[terms.second, 1:]
    if not varied.any():
        return psf, found
    a, b, c = varied @ field[:, 1:].T
    change = np.stack([1 + np.sqrt(2) * a, b, b, 1 + np.sqrt(2) * c], -1).reshape(-1, 2, 2)
    root = power(np.tensordot(field[:, : len(psf.widths)], psf.widths, 1), 0.5)
    widths = over_field(field, (root @ change @ root).reshape(-1, 4))
    if widths is None:
        return psf, found
    found = found.copy()
    found[terms.second, 1:] = 0
    return psf.with_widths(widths.reshape(-1, 2, 2)), found

# SPDX-License-Identifier: Apache-2.0
"""Learn a frame's PSF, colour gains and photon noise from its own bright stars."""

import math
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np
from scipy import spatial
from scipy.linalg import lapack

from starpos.detection._learn import light_noise, marginal_equations, phase_fluxes
from starpos.detection._moments import (
    clip_widths,
    own_shapes,
    relative_widths,
    squared_widths,
    window_moments,
    without_window,
)
from starpos.detection._pixels import smooth_mosaic
from starpos.detection._sky import median
from starpos.detection.background import SkyPlane
from starpos.detection.fit import Fit, Response, fit_stars, gains_at
from starpos.detection.psf import BROAD, MONOMIALS, NARROW, Psf, gaussian, power
from starpos.detection.stamps import (
    FARTHEST,
    NARROWEST,
    NARROWEST_WINDOW,
    Stamps,
    are_dots,
    centroid,
    cut,
    window_for,
)

# Minimum number of stars for a variation over the field,
PLACES = 12
# and widths that vary over the field must be better than constant ones by this F.
SIGNIFICANT = 4.0
# and maximum distance of any of these stars from it, over the median distance, in a number of rounds.
OUTLYING, FIELD_ROUNDS = 6.0, 4
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
    field, own, kept = psf.monomials(x, y), ratio.reshape(-1, 4), np.ones(len(x), bool)
    for _ in range(FIELD_ROUNDS):
        if np.count_nonzero(kept) < PLACES:
            return psf
        weighted = field.T * (weight * kept)
        normal = weighted @ field
        # what the places do not show, as on a line, is 0
        normal.flat[:: MONOMIALS + 1] += 1e-12 * normal.trace()
        fitted = np.linalg.solve(normal, weighted @ own)
        off, those = np.sqrt(weight) * np.abs(own - field @ fitted).max(1), kept
        # pairs are wide but say nothing about the optics
        kept = off < OUTLYING * median(off)
        if (kept == those).all():
            break
    if np.count_nonzero(kept) < PLACES:
        return psf
    weight = weight * kept
    mean = weight @ own / weight.sum()
    before, after = (weight @ ((own - model) ** 2).sum(1) for model in (mean, field @ fitted))
    if (before - after) / (MONOMIALS - 1) < SIGNIFICANT * after / (np.count_nonzero(kept) - MONOMIALS):
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


def elongation(psf: Psf) -> float:
    """How many times longer than wide a star is, from 1 to 2, in steps: the terms of each are made once."""
    across, along = (math.hypot(*axis) for axis in psf.axes[::-1].tolist())
    return round(STEPS * min(max(across / along, 1.0), 2.0)) / STEPS


def _rank(orders: np.ndarray, longer: float) -> np.ndarray:
    """The order that terms (T, 2) count as: along a trail they count less, by the ratio of its length to its width."""
    return orders[:, 0] / longer + orders[:, 1]


@lru_cache(maxsize=64)
def even_terms(longer: float, highest: int) -> Terms:
    """Terms of even order, up to `highest` across the trail and, for a `longer` star, up to twice that along it."""
    grid = [(i, j) for i in range(2 * highest + 1) for j in range(highest + 1) if (i + j) % 2 == 0]
    orders = np.array(grid[1:], np.int32)
    orders = orders[_rank(orders, longer) <= highest]
    steps = np.arange(2, highest + 1, 2)
    candidates = (_rank(orders, longer) <= steps[:, None])[..., None]
    return Terms(orders, candidates, np.full((len(orders), 1), WORTH))


@lru_cache(maxsize=64)
def all_terms(longer: float, highest: int, varied: bool) -> Terms:
    """The even terms, then coma, then variations over the field, if asked for."""
    even = even_terms(longer, highest)
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


def refine(psf: Psf, stamps: Stamps, fit: Fit, response: Response, terms: Terms) -> Psf:
    """The Psf whose series fits N fitted stars best, by weighted linear least squares with free positions and gains.

    terms: those that are tried; they are taken if they are worth their price
    """
    local = psf.at(fit.x, fit.y)
    # 2 % of the model as extra noise: the brightest star must not be the only teacher
    noisier = replace(response, misfit=math.hypot(response.misfit, 0.02))
    scale = gains_at(fit.gains, stamps.phase) * fit.flux.astype(np.float32)[:, None, None]
    weight = fit.used * scale**2 / noisier.variance(stamps.noise, fit.model)
    normal, right = marginal_equations(
        local.axes, local.series, *stamps.corner(fit.x, fit.y), stamps.signal / scale, weight, stamps.phase,
        len(response.gain), terms.orders,
    )  # fmt: skip
    count, places = terms.candidates.shape[1:]
    field = psf.monomials(fit.x, fit.y)[:, :places]
    each = (field[:, :, None] * field[:, None]).reshape(len(field), -1).T @ normal.reshape(len(field), -1)
    normal = each.reshape(places, places, count, count).transpose(2, 0, 3, 1).reshape(count * places, -1)
    right = (right.T @ field).ravel()
    normal.flat[:: len(right) + 1] += LIKELY**-2
    found = _worthy(normal, right, terms).reshape(count, places)
    if places > 1:
        psf, found = _absorbed(psf, field, terms, found)
    used = found.any(1)
    i, j = np.concatenate([[(0, 0)], terms.orders[used]]).T
    series = np.zeros((places if found[:, 1:].any() else 1, i.max() + 1, j.max() + 1))
    # unit flux: the other terms integrate to zero
    series[0, 0, 0] = 1
    series[:, i[1:], j[1:]] = found[used, : len(series)].T
    return replace(psf, series=series)


def _worthy(normal: np.ndarray, right: np.ndarray, terms: Terms) -> np.ndarray:
    """The coefficients (M,) that minimise chi-square, by its normal equations, plus their price; 0 for others."""
    found, taken, best, price = np.zeros(len(right)), np.zeros(len(right), bool), 0.0, terms.price.ravel()
    for candidate in terms.candidates.reshape(-1, len(right)):
        wanted = taken | candidate
        index = wanted.nonzero()[0]
        _, solution, failed = lapack.dposv(normal.take(index, 0).take(index, 1), right[index])
        gain = right[index] @ solution - price @ wanted
        if not failed and gain > best:
            best, taken = gain, wanted
            found = np.zeros(len(right))
            found[index] = solution
    return found


def _absorbed(psf: Psf, field: np.ndarray, terms: Terms, found: np.ndarray) -> tuple[Psf, np.ndarray]:
    """Psf and coefficients with the field's second-order terms moved into the widths, which hold any amount of them."""
    varied = found[terms.second, 1:]
    if not varied.any():
        return psf, found
    a, b, c = varied @ field[:, 1:].T
    change = np.stack([1 + np.sqrt(2) * a, b, b, 1 + np.sqrt(2) * c], -1).reshape(-1, 2, 2)
    root = power(np.tensordot(field[:, : len(psf.widths)], psf.widths, 1), 0.5)
    widths = np.linalg.lstsq(field, (root @ change @ root).reshape(-1, 4), rcond=None)[0]
    found = found.copy()
    found[terms.second, 1:] = 0
    return psf.with_widths(widths.reshape(-1, 2, 2)), found


# Widths of the PSF, px, tried in a frame with fewer than ALIKE stars, and number of the highest peaks that decide.
USUAL_SIGMAS, FEW = (1.1, 0.55, 2.2, 4.4), 10
# Minimum factor of light by which a usual width replaces a learnt one.
CLEARLY = 1.1
# Radius (px) around a peak that is used while the width of stars is unknown.
SIGHT = 12
# Minimum height (sigma of the smoothed noise) and maximum number of the peaks that the PSF is learnt from,
BRIGHT, TEACHERS = 20, 250
# and their maximum number of pixels in total, which limits wide stars.
TEACHING_PIXELS = 12000
# Maximum share of the residual in a star's squared light, plus noise, plus three times other stars' share, for a star to
# learn from; minimum of the squared light (DN2), so that darkness has a share too.
UNLIKE, DARKEST = 0.005, 1e-9
# Rounds in which each star's own shape is measured, and in each of them rounds of centring.
OWN_ROUNDS, CENTRINGS = 3, 2
# Rounds in which one window is fitted to all, from this sigma (px) where none has a shape; the least squared width (px2)
# of an image through it.
COMMON_ROUNDS, FIRST_SIGMA, THINNEST = 4, 1.5, 0.1
# Number of stars that agree by more than chance, and their maximum difference (log of width, ellipticity); twigs differ.
ALIKE, LIKENESS = 5, 0.6
# Rounds of fitting and refining the PSF, and the order of its terms.
ROUNDS, ORDER = 2, 6
# On a mosaic, colour and shape of stars narrower than FINE_FWHM (px) are hard to separate: FINE_ROUNDS more rounds are
# made, if there are FINE_STARS or more.
FINE_FWHM, FINE_STARS, FINE_ROUNDS = 2.3, 6, 4
# Stars of at least this FWHM (px) may be rings with sharp edges if the PSF describes more than this share of the light
# wrongly: then up to RING_ROUNDS more rounds are made, with terms of this order.
RING_FWHM, POOR, RING_ROUNDS, RING_ORDER = 5.0, 0.05, 6, 14
# Rounds in which the gains of a mosaic's phases are averaged, limit of outliers in sigma; DN far below any star's;
# the least gain, and the least and the largest scatter of single stars' gains.
GAIN_ROUNDS, OUTLYING_GAIN, DARKEST_MEAN, MIN_GAIN, SPREADS = 4, 4.0, 1e-3, 0.02, (0.01, 0.5)
# Residuals of more sigma teach nothing of the noise.
DEVIANT = 5.0
# Largest distance from a star's centre to its stamp's edge, px.
MAX_REACH = 20
# Brighter stars than this SNR get no more weight when the widths over the field are fitted.
LOUDEST = 100
# px2 that the smoothing which removes a mosaic adds to a covariance: its response vanishes at the Nyquist frequency.
SMOOTHING_WIDTH = 0.5


@dataclass(frozen=True, eq=False)
class Lesson:
    """A frame's PSF and response, and the distance from a star (px) out to which its light is used."""

    psf: Psf
    response: Response
    reach: int


def learn(sky: SkyPlane, x: np.ndarray, y: np.ndarray, height: np.ndarray) -> Lesson:
    """Learn from the peaks x, y (N,) int px and their height (N,), highest first; defaults where they teach nothing."""
    response = Response(np.ones(len(sky.level)), 0.3, 0.0, 0.0)
    psf, stamps, x, y = _teachers(sky, x, y, height)
    fine = sky.is_mosaic and psf.fwhm_px < FINE_FWHM and len(x) >= FINE_STARS
    rounds = ROUNDS + FINE_ROUNDS * fine
    for round_ in range(rounds + RING_ROUNDS):
        if len(x) == 0:
            break
        fit = fit_stars(stamps, psf, x, y, response, rounds=3, leverage=True)
        sound = np.isfinite(fit.chi2) & (fit.flux > 0) & np.isfinite(fit.covariance).all((1, 2))
        sound &= np.hypot(fit.x - stamps.x, fit.y - stamps.y) < 3
        if not sound.any():
            break
        # two stars in one image would teach a wrong PSF and too much photon noise
        strange, error = _strangeness(stamps, fit)
        # compared with the best 30 %, because most of the brightest may be pairs
        usual = np.sort(strange[sound])[int(0.3 * np.count_nonzero(sound))]
        sound &= strange < 3 * max(0, usual) + 3 * error + UNLIKE
        stamps, fit = stamps.select(sound), fit.select(sound)
        x, y = fit.x, fit.y
        response = respond(stamps, psf, fit, response)
        ring = round_ >= rounds
        if ring and (psf.fwhm_px < RING_FWHM or response.misfit < POOR):
            # the response has now been learnt with the final PSF
            break
        # odd terms only in the last round: the first stars still include pairs, which look like coma
        if round_ == rounds - 1:
            terms = all_terms(elongation(psf), ORDER, len(x) >= PLACES)
        else:
            terms = even_terms(elongation(psf), RING_ORDER if ring else ORDER)
        psf = refine(psf, stamps, fit, response, terms)
    return Lesson(psf, response, reach_of(psf))


def _strangeness(stamps: Stamps, fit: Fit) -> tuple[np.ndarray, np.ndarray]:
    """The residuals' squared light beyond the sky's noise over the model's, (N,), and its error (N,)."""
    noise2, light2, left = ((fit.used * image) ** 2 for image in (stamps.noise, fit.model, fit.residual))
    light2 = np.maximum(light2.sum((1, 2)), DARKEST)
    beyond = (left - noise2 * (1 - fit.leverage)).sum((1, 2))
    return beyond / light2, np.sqrt(2 * (noise2**2).sum((1, 2))) / light2


def _teachers(
    sky: SkyPlane, x: np.ndarray, y: np.ndarray, height: np.ndarray
) -> tuple[Psf, Stamps, np.ndarray, np.ndarray]:
    """The isolated bright stars: a Gaussian Psf of their shape, their Stamps and their centroids x, y (N,) px."""
    clear = np.ones(len(x), bool)
    for streak in sky.streaks:
        clear &= streak.at(y, x)[0] == 0
    alone, high = _isolated(x, y, height)
    # where no bright star is isolated, fainter ones may be; where none is, stars are wider than their distances
    choices = (clear & alone & (height > BRIGHT), clear & alone, clear & high)
    bright = next((c for c in choices if c.any()), choices[-1]).nonzero()[0]
    bright = bright[~are_dots(sky, x[bright], y[bright])][:TEACHERS]
    around = cut(sky, x[bright], y[bright], SIGHT)
    light, full = around.signal, np.any(around.full, axis=(1, 2))
    # the shapes of fainter stars are noise
    clearly_many = bool(np.count_nonzero(height[bright] > BRIGHT) > ALIKE)
    bright, (light, blur) = bright[~full], grey(light if not full.any() else light[~full], sky)
    shape, alike = _typical_shape(light, blur, clearly_many)
    bright = bright[alike]
    # a shape as wide as the stamps is the sky's
    if shape is not None and squared_widths(shape)[0, 0] > 0.9 * (SIGHT / 2) ** 2:
        shape = None
    if shape is None or len(bright) < ALIKE:
        around = _highest(sky, x[clear], y[clear])
        shape, learnt = _likeliest(around, shape, Response(np.ones(len(sky.level)), 0.3, 0.0, 0.0))
        if not learnt:
            return gaussian(shape[0]), around.select(slice(0)), np.zeros(0), np.zeros(0)
    psf = gaussian(shape[0], x[bright], y[bright])
    stamps = cut(sky, x[bright], y[bright], reach_of(psf))
    smooth, blur = grey(stamps.signal, sky)
    x, y = centroid(smooth, stamps.x, stamps.y, shape)
    window = window_for(shape)
    mass, _, seen = window_moments(smooth, *stamps.corner(x, y), window)
    ratio = psf.axes @ (without_window(seen, window) - blur * np.eye(2)) @ psf.axes.T
    ratio[np.isnan(ratio)] = 0
    extremes = squared_widths(ratio)
    near = (extremes[:, 0] > NARROW) & (extremes[:, 1] < BROAD)
    # of the four phases of a mosaic
    core = slice(stamps.reach, stamps.reach + 2)
    weight = np.clip(mass / stamps.noise[:, core, core].mean((1, 2)), 1, LOUDEST) ** 2
    psf = widened(psf, x[near], y[near], ratio[near], weight[near])
    widths = relative_widths(seen, psf.shapes_at(x, y) + blur * np.eye(2), window)
    alike = ((widths[:, 0] > 0.6) & (widths[:, 1] < 1.4)).nonzero()[0]
    alike = alike[: max(TEACHING_PIXELS // stamps.signal[0].size, 40)]
    return psf, stamps.select(alike), x[alike], y[alike]


def _highest(sky: SkyPlane, x: np.ndarray, y: np.ndarray) -> Stamps:
    """Stamps of the first FEW of the peaks x, y (N,) int px, of those that are not saturated if there are any."""
    full = cut(sky, x[:TEACHERS], y[:TEACHERS], 1).full.any((1, 2))
    few = np.argsort(full, kind="stable")[:FEW]
    return cut(sky, x[few], y[few], SIGHT)


def _likeliest(stamps: Stamps, shape: np.ndarray | None, response: Response) -> tuple[np.ndarray, bool]:
    """The Gaussian shape (1, 2, 2) px2 that finds most light in the stamps, and whether it is the given one, if any."""
    choices = [np.eye(2)[None] * sigma**2 for sigma in USUAL_SIGMAS]
    if not len(stamps.x):
        return choices[0], False
    # what is much wider than the learnt shape is not a star
    choices = choices if shape is None else [shape, *choices[:2]]
    found = []
    for choice in choices:
        psf = gaussian(choice[0])
        fit = fit_stars(stamps, psf, stamps.x.astype(float), stamps.y.astype(float), response, rounds=3)
        found.append(np.median(np.nan_to_num(fit.flux / fit.flux_sigma)))
    best = int(np.argmax(found))
    learnt = shape is not None and found[best] < CLEARLY * found[0]
    return choices[0 if learnt else best], learnt


def _typical_shape(light: np.ndarray, blur: float, many: bool) -> tuple[np.ndarray | None, np.ndarray]:
    """The covariance (1, 2, 2) px2 of most stars, signals (N, S, S), and which have similar shapes, (N,) bool.

    Stars have, and twigs have not: of many stars, those are left out that lie far from the median shape, or, if most
    do, from the shape at which they are densest. blur, px2, is what smoothing added. None if no star can be measured.
    """
    reach = light.shape[1] // 2
    widest, alike = (reach / 2) ** 2, np.ones(len(light), bool)
    shape, values = own_shapes(
        light, (reach / 4) ** 2, NARROWEST_WINDOW, NARROWEST, widest, OWN_ROUNDS, CENTRINGS, FARTHEST
    )
    sound = (values[:, 0] > NARROWEST) & (values[:, 1] < widest)
    if many and np.count_nonzero(sound) >= ALIKE:
        xx, xy, yy = (shape[:, i, j] for i, j in ((0, 0), (0, 1), (1, 1)))
        look = np.stack([np.log(xx + yy) / 2, (xx - yy) / (xx + yy), 2 * xy / (xx + yy)], 1)
        near = np.linalg.norm(look - _medians(look), axis=1) < LIKENESS
        if np.count_nonzero(near & (values[:, 0] > NARROWEST)) <= 0.5 * len(light):
            densest = np.argmin(spatial.cKDTree(look[sound]).query(look[sound], ALIKE)[0][:, -1])
            alike = sound & (np.linalg.norm(look - look[sound][densest], axis=1) < LIKENESS)
    typical, middle = np.eye(2)[None] * FIRST_SIGMA**2, np.full(len(light), reach)
    if (sound & alike).any():
        typical = _medians(shape[sound & alike])[None]
    x, y = centroid(light, middle, middle, typical)
    # faint stars' own windows follow their noise: once more through one window of the shape that all have
    for _ in range(COMMON_ROUNDS):
        window = window_for(typical)
        seen = window_moments(light, -x, -y, window)[2]
        usable = alike & (squared_widths(seen)[:, 0] > THINNEST)
        if not usable.any():
            return None, alike
        seen = _medians(seen[usable])[None]
        over = clip_widths(seen, 0.0, np.inf, -1.0) - clip_widths(window, 0.0, np.inf, -1.0)
        typical = clip_widths(over, 1 / widest, 1 / NARROWEST, -1.0)
    return clip_widths(typical - blur * np.eye(2), NARROWEST, np.inf, 1.0), alike


def _medians(values: np.ndarray) -> np.ndarray:
    """The medians (...) of N arrays, (N, ...): np.median has the same, but takes longer to begin."""
    columns = values.reshape(len(values), -1).T.copy()
    return np.array([median(column) for column in columns]).reshape(values.shape[1:])


def reach_of(psf: Psf) -> int:
    """Distance from a star's centre, px, at which its stamp ends: 3.5 widths of the widest star in the field."""
    return min(max(math.ceil(3.5 * math.sqrt(psf.widest_px2())) + 1, 4), MAX_REACH)


def grey(signal: np.ndarray, sky: SkyPlane) -> tuple[np.ndarray, float]:
    """Signals (N, S, S) smoothed so that the mosaic's pattern vanishes, and the px2 which that added to covariances."""
    if not sky.is_mosaic:
        return signal, 0.0
    return smooth_mosaic(signal), SMOOTHING_WIDTH


def _isolated(x: np.ndarray, y: np.ndarray, height: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Which peaks (N,) have no neighbour in SIGHT above a fiftieth of their height, and which have no higher one."""
    pairs = spatial.cKDTree(np.stack([x, y], 1)).query_pairs(SIGHT, output_type="ndarray")
    alone, high = np.ones((2, len(x)), bool)
    for a, b in (pairs.T, pairs.T[::-1]):
        alone[a[height[b] > 0.02 * height[a]]] = False
        high[a[height[b] > height[a]]] = False
    return alone, high


def respond(stamps: Stamps, psf: Psf, fit: Fit, before: Response) -> Response:
    """The Response of the fitted stars: gains of the phases, their scatter, and the noise that grows with light."""
    gain, spread = before.gain, before.colour_spread
    if len(gain) > 1:
        value = psf.at(fit.x, fit.y).evaluate(*stamps.corner(fit.x, fit.y), stamps.size)
        gain, spread = _gains(stamps, value, before)
    photon, misfit = light_noise(
        stamps.noise, fit.model, fit.residual, fit.used, fit.leverage, before.dn_per_photon, before.misfit, DEVIANT
    )  # fmt: skip
    return Response(gain, spread, photon, misfit)


def _gains(stamps: Stamps, value: np.ndarray, before: Response) -> tuple[np.ndarray, float]:
    """Gains of the mosaic's phases (P,), mean 1, and the scatter of single stars' gains about them, without noise.

    value (N, S, S): the PSF at the stars' pixels.
    """
    flux, information = phase_fluxes(
        stamps.signal, stamps.noise, stamps.good, stamps.phase, value, before.dn_per_photon, before.misfit,
        len(before.gain),
    )  # fmt: skip
    # the light of each phase by the PSF over the star's mean, and its variance
    mean = np.maximum(flux.mean(1, keepdims=True), DARKEST_MEAN)
    own, error2 = flux / mean, 1 / np.maximum(information * mean**2, 1e-12)
    gain, spread2 = _medians(own), 0.0
    for _ in range(GAIN_ROUNDS):
        weight = 1 / (error2 + spread2 + 1e-6)
        weight *= (own - gain) ** 2 * weight < OUTLYING_GAIN**2
        gain = np.maximum((weight * own).sum(0) / np.maximum(weight.sum(0), 1e-12), MIN_GAIN)
        gain *= len(gain) / gain.sum()
        spread2 = max(0.0, (weight * ((own / gain - 1) ** 2 - error2)).sum() / max(weight.sum(), 1e-12))
    return gain, float(np.clip(np.sqrt(spread2), *SPREADS))

# SPDX-License-Identifier: Apache-2.0
"""What a frame's own bright stars teach: its PSF, its colour gains and its photon noise."""

from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage, spatial

from starpos.detection.fit import Response, fit_stars, gains_at
from starpos.detection.psf import BROAD, NARROW, Psf, gaussian
from starpos.detection.refine import all_terms, even_terms, refine, widened
from starpos.detection.shape import (
    NARROWEST,
    frame_shape,
    moments,
    own_shape,
    relative_widths,
    window_for,
)
from starpos.detection.stamps import are_dots, cut

DEFAULT_SIGMA = 1.1  # px, of a frame without a star to learn from
BRIGHT = 20  # sigma of the smoothed noise: from here up a peak can teach
TEACHERS = 250
TEACHING_PIXELS = 12000  # of wide stars fewer are enough
# a star does not teach if the PSF leaves more of its squared light than this, three times what others do, and noise
UNLIKE = 0.005
ALIKE, LIKENESS = 5, 0.6  # so many stars are more alike than twigs by chance; log of width, and ellipticity
ROUNDS, ORDER = 2, 6  # of fits and refinements; of the terms
# px: on a mosaic the colours of narrower stars look like their shape; at least so many tell them apart in more rounds
FINE_FWHM, FINE_STARS, FINE_ROUNDS = 2.3, 6, 4
# px: stars at least as wide may be rings, with sharp edges, if the PSF fails to describe more of a pixel's light
RING_FWHM, POOR = 5.0, 0.05
RING_ROUNDS, RING_ORDER = 6, 14  # so many more rounds then, and terms of that order
MAX_REACH = 20
LOUDEST = 100  # SNR: the widths of a brighter star tell no more of the field
SMOOTHING = np.array([0.25, 0.5, 0.25], np.float32)  # null at Nyquist: a mosaic smoothed by it is grey
SMOOTHING_WIDTH = 0.5  # px2 it adds to a covariance


@dataclass(frozen=True, eq=False)
class Lesson:
    """A frame's PSF and response, and how far from a star (px) its light is worth using."""

    psf: Psf
    response: Response
    reach: int


def learn(plane, background, x, y, height, saturation) -> Lesson:
    """What the peaks x, y (N,) of that height, highest first, teach; defaults where they teach nothing."""
    response = Response(np.ones(len(background.level)), 0.3, 0.0, 0.0)
    psf, stamps, x, y = _teachers(plane, background, x, y, height, saturation)
    fine = background.is_mosaic and psf.fwhm_px < FINE_FWHM and len(x) >= FINE_STARS
    rounds = ROUNDS + FINE_ROUNDS * fine
    for round_ in range(rounds + RING_ROUNDS):
        if len(x) == 0:
            break
        fit = fit_stars(stamps, psf, x, y, response, rounds=3)
        sound = np.isfinite(fit.chi2) & (fit.flux > 0) & np.isfinite(fit.covariance).all((1, 2))
        sound &= np.hypot(fit.x - stamps.x, fit.y - stamps.y) < 3
        if not sound.any():
            break
        # the best three tenths are the measure: pairs are bright, and may be most of the brightest
        strange, error = _strangeness(stamps, fit)
        sound &= strange < 3 * max(0, np.quantile(strange[sound], 0.3)) + 3 * error + UNLIKE
        stamps, x, y = stamps.take(sound), fit.x[sound], fit.y[sound]
        response = _respond(stamps, psf, x, y, fit, sound, response)
        ring = round_ >= rounds
        if ring and (psf.fwhm_px < RING_FWHM or response.misfit < POOR):
            break  # the response was learnt once more: with the last PSF, of the stars that are like it
        # pairs are still among the stars of the first round, and look like coma
        terms = (
            all_terms(psf, ORDER, len(x))
            if round_ == rounds - 1
            else even_terms(psf, RING_ORDER if ring else ORDER)
        )
        psf = _shape_up(stamps, psf, fit, sound, response, terms)
    return Lesson(psf, response, reach_of(psf))


def _teachers(plane, background, x, y, height, saturation):
    """The Gaussians most like the bright stars alone in their surroundings, their Stamps, and x, y (N,) of each."""
    clear = np.ones(len(x), bool)
    for streak in background.streaks:
        clear &= streak.at(y, x)[0] == 0
    bright = np.flatnonzero(clear & (height > BRIGHT))
    if len(bright) == 0:
        bright = np.flatnonzero(clear)[:TEACHERS]
    bright = bright[_isolated(x, y, height, bright)]
    bright = bright[~are_dots(plane, background, x[bright], y[bright])][:TEACHERS]
    stamps = cut(plane, background, x[bright], y[bright], 12, saturation)
    stamps = stamps.take(~stamps.full.any((1, 2)))
    if np.count_nonzero(height[bright] > BRIGHT) > ALIKE and len(stamps.x):  # fainter ones' shapes are noise
        stamps = stamps.take(_most_alike(grey(stamps, background)[0]))
    shape = frame_shape(*grey(stamps, background)) if len(stamps.x) else None
    if shape is None:
        return gaussian(np.eye(2) * DEFAULT_SIGMA**2), stamps.take(slice(0)), np.zeros(0), np.zeros(0)
    psf = gaussian(shape, stamps.x, stamps.y)
    stamps = cut(plane, background, stamps.x, stamps.y, reach_of(psf), saturation)
    smooth, blur = grey(stamps, background)
    x, y = centroid(smooth, shape)
    window = window_for(shape)
    mass, _, seen = moments(smooth, x, y, window)
    ratio = np.nan_to_num(psf.axes @ (own_shape(seen, window) - blur * np.eye(2)) @ psf.axes.T)
    extremes = np.linalg.eigvalsh(ratio)
    near = (extremes[:, 0] > NARROW) & (extremes[:, 1] < BROAD)
    weight = np.clip(mass / np.median(stamps.noise, axis=(1, 2)), 1, LOUDEST) ** 2
    psf = widened(psf, x[near], y[near], ratio[near], weight[near])
    widths = relative_widths(seen, psf.at(x, y).shape + blur * np.eye(2), window)
    alike = np.flatnonzero((widths[:, 0] > 0.6) & (widths[:, 1] < 1.4))
    alike = alike[: max(TEACHING_PIXELS // stamps.signal[0].size, 40)]
    return psf, stamps.take(alike), x[alike], y[alike]


def _most_alike(stamps):
    """Which stamps (N,) bool are somewhat alike, as stars are and twigs are not: most, or those around the most alike."""
    shape, widest = np.eye(2) * (stamps.reach / 4) ** 2, (stamps.reach / 2) ** 2
    for _ in range(3):
        window = window_for(shape)
        own = own_shape(moments(stamps, *centroid(stamps, shape, rounds=2), window)[2], window)
        values, vectors = np.linalg.eigh(np.nan_to_num(own))
        values = np.where(values > 0, np.clip(values, NARROWEST, widest), widest)
        shape = (vectors * values[:, None, :]) @ vectors.transpose(0, 2, 1)
    xx, xy, yy = (shape[:, i, j] for i, j in ((0, 0), (0, 1), (1, 1)))
    look = np.stack([np.log(xx + yy) / 2, (xx - yy) / (xx + yy), 2 * xy / (xx + yy)], 1)
    alike = np.linalg.norm(look - np.median(look, axis=0), axis=1) < LIKENESS
    alike &= values[:, 0] > NARROWEST
    sound = (values[:, 0] > NARROWEST) & (values[:, 1] < widest)
    if np.count_nonzero(alike) > 0.5 * len(alike) or np.count_nonzero(sound) < ALIKE:
        return np.ones(len(alike), bool)
    densest = np.argmin(spatial.cKDTree(look[sound]).query(look[sound], ALIKE)[0][:, -1])
    return sound & (np.linalg.norm(look - look[sound][densest], axis=1) < LIKENESS)


def reach_of(psf) -> int:
    """px from the centre at which a stamp may end: 3.5 widths along the longer axis, where that is longest."""
    x, y = np.linspace(*psf.box, 5).T
    widest = np.linalg.eigvalsh(psf.at(*(v.ravel() for v in np.meshgrid(x, y))).shape).max()
    return int(np.clip(np.ceil(3.5 * np.sqrt(widest)) + 1, 4, MAX_REACH))


def grey(stamps, background):
    """Stamps without the mosaic's pattern, and how much wider (px2) that made the images."""
    if not background.is_mosaic:
        return stamps, 0.0
    signal = ndimage.convolve1d(stamps.signal, SMOOTHING, axis=1, mode="nearest")
    signal = ndimage.convolve1d(signal, SMOOTHING, axis=2, mode="nearest")
    return replace(stamps, signal=signal), SMOOTHING_WIDTH


def centroid(stamps, shape, rounds=3):
    """x, y (N,) px: the windowed centroids of stars of covariance shape, never further than 2 px from the peak."""
    x, y = stamps.x.astype(float), stamps.y.astype(float)
    window = window_for(shape)
    gain = np.eye(2) + shape @ np.linalg.inv(window)  # of a displacement the window shows only a part
    for _ in range(rounds):
        _, step, _ = moments(stamps, x, y, window)
        step = np.clip(np.nan_to_num((gain @ step[..., None])[..., 0]), -1, 1)
        x = np.clip(x + step[:, 0], stamps.x - 2, stamps.x + 2)
        y = np.clip(y + step[:, 1], stamps.y - 2, stamps.y + 2)
    return x, y


def _isolated(x, y, height, index):
    """Which of the peaks `index` have no neighbour within 12 px of more than a fiftieth of their height."""
    points = np.stack([x, y], 1)
    pairs = spatial.cKDTree(points).query_pairs(12, output_type="ndarray")
    crowded = np.zeros(len(x), bool)
    for a, b in (pairs.T, pairs.T[::-1]):
        crowded[a[height[b] > 0.02 * height[a]]] = True
    return ~crowded[index]


def _strangeness(stamps, fit):
    """(N,) what the PSF leaves of each star, beyond the sky's noise, over what it holds, both squared; and its error.

    Two stars in one image leave much: they would teach a wrong PSF, and what they leave would pass for noise of light.
    """
    noise2 = fit.used * stamps.noise**2
    light2 = np.maximum((fit.used * fit.model**2).sum((1, 2)), 1e-9)
    left = (fit.used * fit.residual**2 - noise2 * (1 - fit.leverage)).sum((1, 2))
    return left / light2, np.sqrt(2 * (noise2**2).sum((1, 2))) / light2


def _respond(stamps, psf, x, y, fit, sound, before):
    """The Response the fitted stars show: gains of the phases, their scatter, and the noise that grows with light."""
    used = fit.used[sound]
    gain, spread = before.gain, before.colour_spread
    if len(gain) > 1:
        gain, spread = _gains(stamps, psf.at(x, y).evaluate(*stamps.offsets(x, y))[0], before)
    noise2 = (stamps.noise**2)[used]
    light, square = np.maximum(fit.model[sound][used], 0), fit.residual[sound][used] ** 2
    square = square / np.maximum(1 - fit.leverage[sound][used], 0.1)
    photon, misfit2 = before.dn_per_photon, before.misfit**2
    for _ in range(4):
        variance = noise2 + photon * light + misfit2 * light**2
        keep = square < 25 * variance if photon + misfit2 > 0 else slice(None)
        photon, misfit2 = _two_terms(light[keep], (square - noise2)[keep], variance[keep])
    # few stars tell too little as often as too much, and too small errors do the more harm
    photon += float(np.sqrt(2 / max(((light / variance) ** 2).sum(), 1e-12)))
    return Response(gain, spread, photon, float(np.sqrt(misfit2)))


def _two_terms(light, excess, variance):
    """a, b >= 0 for which a * light + b * light^2 is the least-squares fit of excess, of that variance."""
    terms = np.stack([light, light * light]).astype(np.float64) / variance
    normal = np.einsum("ik,jk->ij", terms, terms)
    right = np.einsum("ik,k->i", terms, excess / variance)
    if normal[0, 0] <= 0:
        return 0.0, 0.0
    both = np.linalg.lstsq(normal, right, rcond=1e-12)[0]
    if both.min() >= 0:
        return float(both[0]), float(both[1])
    alone = np.maximum(right / np.diag(normal), 0)
    best = int(np.argmax(right * alone))  # the one that takes more off the sum of squares
    return (float(alone[0]), 0.0) if best == 0 else (0.0, float(alone[1]))


def _gains(stamps, value, before):
    """The gains of the mosaic's phases (P,), mean 1, and how far a star's own scatter about them beyond noise."""
    phases = stamps.phase[..., None] == np.arange(len(before.gain))
    weight = (stamps.good / before.variance(stamps.noise, stamps.signal))[..., None] * phases
    information = (weight * (value * value)[..., None]).sum((1, 2))
    own = (weight * (value * stamps.signal)[..., None]).sum((1, 2)) / np.maximum(information, 1e-12)
    mean = np.maximum(own.mean(1, keepdims=True), 1e-3)  # DN: far below any star
    own, error2 = own / mean, 1 / np.maximum(information * mean**2, 1e-12)
    gain, spread2 = np.median(own, 0), 0.0
    for _ in range(4):
        weight = 1 / (error2 + spread2 + 1e-6)
        weight = weight * ((own - gain) ** 2 * weight < 16)
        gain = np.clip((weight * own).sum(0) / np.maximum(weight.sum(0), 1e-12), 0.02, None)
        gain = gain / gain.mean()
        spread2 = max(
            0.0, float((weight * ((own / gain - 1) ** 2 - error2)).sum() / max(weight.sum(), 1e-12))
        )
    return gain, float(np.clip(np.sqrt(spread2), 0.01, 0.5))


def _shape_up(stamps, psf, fit, sound, response, terms):
    """One refinement of the PSF by the stars in stamps, the sound ones of a fit."""
    x, y, flux = fit.x[sound], fit.y[sound], fit.flux[sound].astype(np.float32)
    scale = gains_at(fit.gains[sound], stamps.phase) * flux[:, None, None]
    dx, dy = stamps.offsets(x, y)
    light = scale * psf.at(x, y).evaluate(dx, dy)[0]
    # 2 % of the model as extra noise: the brightest star must not be the only teacher
    variance = response.variance(stamps.noise, light) + (0.02 * light) ** 2
    weight = fit.used[sound] * scale**2 / variance
    return refine(psf, x, y, dx, dy, stamps.signal / scale, weight, stamps.phase, terms)

# SPDX-License-Identifier: Apache-2.0
"""Turn peaks into measured stars: fit each, leave out what is not a star, flag the doubtful ones."""

from dataclasses import replace

import numpy as np
from scipy import spatial

from starpos.detection.background import Background
from starpos.detection.blend import with_companions
from starpos.detection.fit import OUTLIER, Fit, Response, fit_stars
from starpos.detection.learn import Lesson, grey
from starpos.detection.psf import Psf
from starpos.detection.shape import centroid, moments, relative_widths, window_for
from starpos.detection.stamps import Stamps, cut, uneven
from starpos.frames.stars import BLENDED, EDGE, ELONGATED, SATURATED

# Outliers of up to so many pixels are a hot pixel or a cosmic ray on the star, not another source.
SPECK = 3
# A spike is so many times sharper than a star.
SPIKE = 3
# Widths of the PSF (3 are 1.3 FWHM): of closer pairs each star's position depends on the other's.
RESOLVED = 3.0
# A single star's chi-square stays below this; twigs, nebulae and covered stars exceed it.
STRANGE = 3.0
# An image with more than so many times a star's squared width is not a single star.
WIDE = 1.7
# If it is narrower than this across, and has this SNR, it may be several stars in a row: it is kept, with a flag.
NARROW, CERTAIN = 1.2, 60
# Pixels with so many times the noise of the quietest pixel of their stamp lie on a streak.
LOUD = 3


def measure(
    plane: np.ndarray,
    background: Background,
    x: np.ndarray,
    y: np.ndarray,
    lesson: Lesson,
    saturation: float,
    min_snr: float,
) -> dict[str, np.ndarray]:
    """Measure the stars among the peaks x, y (N,) int px: columns x, y, flux, snr, covariance, flags, chi2, wide.

    The rows are in no order. saturation is the DN from which a pixel is saturated, min_snr the SNR a star must have.
    """
    psf = lesson.psf

    def cut_at(x: np.ndarray, y: np.ndarray) -> tuple[Stamps, np.ndarray]:
        stamps = _levelled(cut(plane, background, x, y, lesson.reach, saturation))
        spike, around = _spikes(stamps, lesson)
        signal = np.where(spike, around, stamps.signal)
        return replace(stamps, signal=signal, good=stamps.good & ~spike), spike

    stamps, spike = cut_at(x, y)
    shape = psf.at(x, y).shape
    x, y = centroid(grey(stamps, background)[0], shape)
    fit = fit_stars(stamps, psf, x, y, lesson.response)
    stamps, spike, fit = with_companions(stamps, spike, fit, psf, lesson.response, cut_at)
    smooth, blur = grey(_own_light(stamps, fit, spike), background)
    shape = psf.at(stamps.x, stamps.y).shape
    window = window_for(shape)
    _, _, seen = moments(smooth, fit.x, fit.y, window)
    widths = relative_widths(seen, shape + blur * np.eye(2), window)
    with np.errstate(invalid="ignore", divide="ignore"):
        snr = fit.flux / fit.flux_sigma
        c = fit.covariance * _misfit(fit)[:, None, None]
        # SNR in the sky's noise
        matched = np.sqrt(((fit.model / stamps.noise) ** 2 * fit.used).sum((1, 2)))
        sound = np.isfinite(snr) & (c[:, 0, 0] > 0) & (c[:, 0, 0] * c[:, 1, 1] > c[:, 0, 1] ** 2)
        sound &= np.hypot(fit.x - stamps.x, fit.y - stamps.y) < 2 + lesson.reach / 2
        sound &= (fit.flux > 0) & (matched >= min_snr)
        sound &= ~_is_dot(stamps, fit, lesson.response)
        sound &= (fit.x >= 0) & (fit.x <= background.width - 1)
        sound &= (fit.y >= 0) & (fit.y <= background.height - 1)
        slack = 3 / matched
        # through a window wider than the star, noise changes the width more
        loose = slack * np.sqrt(np.linalg.det(window) / np.linalg.det(shape))
        full = (stamps.full & _core(stamps, fit, psf, 2)).any((1, 2))
        wide = (widths[:, 1] > WIDE + loose - slack) & ~full
        sound &= full | (widths[:, 0] > 0.45 - loose)
        sound &= ~wide | ((widths[:, 0] < NARROW) & (matched > CERTAIN))
        edge = (~stamps.good & ~stamps.full & ~spike & _core(stamps, fit, psf, 3)).any((1, 2))
        foreign = (np.maximum(fit.residual, 0) * fit.outlier).sum((1, 2)) > 0.05 * fit.flux
        foreign |= (_misfit(fit) > STRANGE) | wide
        elongated = (widths[:, 1] / np.maximum(widths[:, 0], 0.1) > 1.35 + slack) & ~full & ~edge
    flags = SATURATED * full + EDGE * edge + ELONGATED * elongated + BLENDED * foreign
    columns = {"x": fit.x, "y": fit.y, "flux": fit.flux, "snr": snr, "covariance": c, "flags": flags}
    columns |= {"chi2": fit.chi2, "wide": wide}
    return {name: column[sound] for name, column in columns.items()}


def _misfit(fit: Fit) -> np.ndarray:
    """Factors (N,) on the covariance: chi2 where it is above what chance allows, else 1."""
    freedom = np.maximum(fit.used.sum((1, 2)) - 3, 1)
    return np.where(fit.chi2 > 1 + 4 * np.sqrt(2 / freedom), fit.chi2, 1.0)


def _levelled(stamps: Stamps) -> Stamps:
    """Stamps with level and noise of the sky corrected by what the pixels at their rims show."""
    rim = np.ones(stamps.signal.shape[1:], bool)
    rim[1:-1, 1:-1] = False
    signal, noise = stamps.signal[:, rim], stamps.noise[:, rim]
    # the rim of a very bright star is its own light
    own = 0.01 * stamps.signal.max((1, 2)) / np.median(noise, axis=1)
    level, noise = uneven(signal, noise)
    level, noise = (np.where(v > own, v, least)[:, None, None] for v, least in ((level, 0), (noise, 1)))
    level, noise = (v.astype(np.float32) for v in (level, noise))
    return replace(stamps, signal=stamps.signal - level * stamps.noise, noise=stamps.noise * noise)


def _spikes(stamps: Stamps, lesson: Lesson) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (N, S, S) bool much brighter than their neighbours, as in no star, and the mean of their neighbours."""
    beside = np.full(len(stamps.x), -1.0)
    star = lesson.psf.at(stamps.x, stamps.y).evaluate(beside, beside, 3)[0]
    top, beside = star[:, 1, 1], _four(star)[:, 1, 1]
    # at least 1, because a ring has a dark middle
    sharpest = np.maximum(1.0, top / np.maximum(beside, 1e-3 * np.abs(top)))[:, None, None].astype(np.float32)
    gain = lesson.response.of_phase(stamps.phase)
    grey = stamps.signal / gain
    around = _four(grey)
    spike = (grey > SPIKE * sharpest * (around + stamps.noise)) & (stamps.signal > OUTLIER * stamps.noise)
    return spike, around * gain


def _four(image: np.ndarray) -> np.ndarray:
    """The mean of the four pixels beside each of images (N, S, S); beyond the edges the image goes on as on them."""
    wide = np.pad(image, ((0, 0), (1, 1), (1, 1)), "edge")
    return (wide[:, :-2, 1:-1] + wide[:, 2:, 1:-1] + wide[:, 1:-1, :-2] + wide[:, 1:-1, 2:]) * np.float32(
        0.25
    )


def _own_light(stamps: Stamps, fit: Fit, spike: np.ndarray) -> Stamps:
    """Stamps with the model in place of pixels that say nothing about the star's own shape.

    These are hot pixels and cosmic rays, if there are not more than a few, and pixels on a streak, which are noisy.
    """
    speck = fit.outlier & (fit.outlier.sum((1, 2)) <= SPECK)[:, None, None]
    loud = stamps.noise > LOUD * stamps.noise.min((1, 2), keepdims=True)
    return replace(stamps, signal=np.where(speck | loud | spike, fit.model, stamps.signal))


def _core(stamps: Stamps, fit: Fit, psf: Psf, widths: float) -> np.ndarray:
    """Pixels (N, S, S) bool within so many widths of the star's centre."""
    return psf.at(fit.x, fit.y).within(*stamps.offsets(fit.x, fit.y), widths)


def _is_dot(stamps: Stamps, fit: Fit, response: Response) -> np.ndarray:
    """Whether stars (N,) are hot pixels or sharp cosmic rays: one pixel on the sky describes them better than the PSF.

    Where one pixel does not describe them well either (a star on coarse pixels), the PSF must be twice as bad.
    """
    half = max(2, stamps.reach // 2 - 1)
    c = slice(stamps.reach - half, stamps.reach + half + 1)
    signal, noise, residual, model, good = (
        a[:, c, c] for a in (stamps.signal, stamps.noise, fit.residual, fit.model, stamps.good)
    )
    score = good * (signal / noise) ** 2
    one_pixel = score.sum((1, 2)) - (score * (signal > 0)).max((1, 2))
    variance = response.variance(noise, model)
    star = (good * (residual**2 / variance + np.log(variance / noise**2))).sum((1, 2))
    pixels = good.sum((1, 2))
    likely = one_pixel < pixels + 4 * np.sqrt(2 * pixels)
    dot = (one_pixel < star) & (likely | (one_pixel < 0.5 * star))
    return dot & (stamps.full[:, c, c].sum((1, 2)) < SPECK)


def resolve(columns: dict[str, np.ndarray], psf: Psf) -> dict[str, np.ndarray]:
    """Sort the columns by flux, keep one of several fits of the same star, and flag close neighbours as BLENDED.

    A wide image is kept only if no better one was measured there.
    """
    order = np.argsort(-columns["flux"], kind="stable")
    columns = {name: column[order] for name, column in columns.items()}
    wide = columns.pop("wide")
    n = len(order)
    if n == 0:
        return columns
    # in widths of the PSF
    points = np.stack([columns["x"], columns["y"]], 1) @ psf.axes.T
    # the brighter star of each pair first
    pairs = np.sort(spatial.cKDTree(points).query_pairs(6.0, output_type="ndarray"), axis=1)
    apart = np.hypot(*(points[pairs[:, 0]] - points[pairs[:, 1]]).T)
    ratio = columns["flux"][pairs[:, 1]] / columns["flux"][pairs[:, 0]]
    keep = np.ones(n, bool)
    for one, other in (pairs.T, pairs.T[::-1]):
        keep[one[wide[one] & ~wide[other] & (apart < RESOLVED)]] = False
    keep[pairs[keep[pairs[:, 0]] & ((apart < 1.5) | (ratio < 0.01)), 1]] = False
    near = keep[pairs].all(1) & (apart < RESOLVED)
    flags = columns["flags"].copy()
    flags[pairs[near, 1]] |= BLENDED
    flags[pairs[near & (ratio > 0.03), 0]] |= BLENDED
    columns["flags"] = flags.astype(np.uint8)
    return {name: column[keep] for name, column in columns.items()}

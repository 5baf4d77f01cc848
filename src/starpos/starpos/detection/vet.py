# SPDX-License-Identifier: Apache-2.0
"""Turn peaks into measured stars: fit each, leave out what is not a star, flag the doubtful ones."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
from scipy import spatial

from starpos.detection._moments import relative_widths, squared_widths, window_moments
from starpos.detection._vetting import compare_with_pixel, correct_sky, replace_spikes
from starpos.detection.background import SkyPlane
from starpos.detection.fit import OUTLIER, Fit, Response, fit_stars, split_pairs, surprising
from starpos.detection.learn import Lesson, grey
from starpos.detection.psf import Psf
from starpos.detection.stamps import (
    RAISED,
    UNEVEN,
    Stamps,
    centroid,
    cut,
    window_for,
)
from starpos.frames.frame import BLENDED, EDGE, ELONGATED, SATURATED
from starpos.frozen import joined
from starpos.units import SIGMA_PER_MAD

# Maximum size in pixels of an outlier that is a hot pixel or a cosmic ray on the star, not another source.
SPECK = 3
# Minimum sharpness of a spike over a star's.
SPIKE = 3
# Widths of the PSF (3 are 1.3 FWHM): of closer pairs each star's position depends on the other's.
RESOLVED = 3.0
# Farther neighbours are not looked at.
FAR = 6.0
# A single star's chi-square stays below this; twigs, nebulae and covered stars exceed it.
STRANGE = 3.0
# Maximum squared width of a single star's image over a star's.
WIDE = 1.7
# If it is narrower than this across, and has this SNR, it may be several stars in a row: it is kept, with a flag.
NARROW, CERTAIN = 1.2, 60
# Widths of the PSF around a star, within which a saturated pixel, and one that is cut off, spoil it.
CORE = 2.0, 3.0
# The rim of a very bright star is its own light: this share of its brightest pixel.
OWN = 0.01
# Minimum noise of pixels on a streak, over the quietest pixel of their stamp.
LOUD = 3

# A measured star: what `Stars` has of each, chi-square per degree of freedom, and whether its image is too wide.
MEASURED = np.dtype(
    [
        *((name, float) for name in ("x", "y", "flux", "snr", "chi2")),
        ("covariance", float, (2, 2)),
        ("flags", np.uint8),
        ("wide", bool),
    ],
    align=True,
)


def measure(
    sky: SkyPlane, x: np.ndarray, y: np.ndarray, lesson: Lesson, min_snr: float, chunk: int
) -> np.ndarray:
    """Measure the stars among the peaks x, y (N,) int px: an array of MEASURED, in no order.

    min_snr: the SNR a star must have; chunk: about how many are measured at once
    """
    psf = lesson.psf

    def cut_at(x: np.ndarray, y: np.ndarray) -> Stamps:
        stamps = cut(sky, x, y, lesson.reach)
        correct_sky(stamps.signal, stamps.noise, SIGMA_PER_MAD, RAISED, UNEVEN, OWN)
        return _without_spikes(stamps, lesson)

    def select(stamps: Stamps, fit: Fit, wanted: np.ndarray) -> np.ndarray:
        return _measured(stamps, fit, sky, lesson, min_snr, wanted)

    # odd stars of several chunks together, because most chunks have a few
    odd: list[tuple[Stamps, Fit]] = []

    def one_chunk(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        stamps = cut_at(x, y)
        first_x, first_y = centroid(grey(stamps.signal, sky)[0], stamps.x, stamps.y, psf.shapes_at(x, y))
        fit = fit_stars(stamps, psf, first_x, first_y, lesson.response)
        strange = surprising(stamps, fit)
        rows = strange.nonzero()[0]
        if len(rows):
            odd.append((stamps.select(rows), fit.select(rows)))
        return select(stamps, fit, ~strange)

    def with_companions() -> np.ndarray:
        stamps, fit = map(joined, zip(*odd, strict=True))
        odd.clear()
        paired, pairs = split_pairs(stamps, fit, psf, lesson.response, cut_at)
        if pairs is not None:
            stamps = joined([stamps.select(~paired), pairs[0]])
            fit = joined([fit.select(~paired), pairs[1]])
        return select(stamps, fit, np.ones(len(fit.x), bool))

    parts: list[np.ndarray] = []
    # chunks of one size: a small one at the end would take nearly as long to begin
    count = max(1, round(len(x) / chunk))
    ends = [len(x) * k // count for k in range(count + 1)]
    for first, end in pairwise(ends):
        parts.append(one_chunk(x[first:end], y[first:end]))
        if odd and (sum(len(fit.x) for _, fit in odd) >= chunk or end == len(x)):
            parts.append(with_companions())
    return np.concatenate(parts)


def _measured(
    stamps: Stamps, fit: Fit, sky: SkyPlane, lesson: Lesson, min_snr: float, wanted: np.ndarray
) -> np.ndarray:
    """The fitted stars as `measure` gives them, of those that are wanted (N,) and are stars."""
    psf = lesson.psf
    local = psf.at(fit.x, fit.y)
    corner = stamps.corner(fit.x, fit.y)
    matched = fit.sky_snr
    full = _any_within(stamps.full, *corner, local.axes, CORE[0])
    edge = _any_within(~(stamps.good | stamps.full | stamps.spike), *corner, local.axes, CORE[1])
    dot = _is_dot(stamps, fit, lesson.response)
    smooth, blur = grey(_own_light(stamps, fit), sky)
    shape = psf.shapes_at(stamps.x, stamps.y)
    window = window_for(shape)
    _, _, seen = window_moments(smooth, *corner, window)
    widths = relative_widths(seen, shape + blur * np.eye(2), window)
    misfit = _misfit(fit)
    with np.errstate(invalid="ignore", divide="ignore"):
        snr = fit.flux / fit.flux_sigma
        c = fit.covariance * misfit[:, None, None]
        sound = wanted & np.isfinite(snr) & (c[:, 0, 0] > 0) & (c[:, 0, 0] * c[:, 1, 1] > c[:, 0, 1] ** 2)
        sound &= np.hypot(fit.x - stamps.x, fit.y - stamps.y) < 2 + lesson.reach / 2
        sound &= (fit.flux > 0) & (matched >= min_snr) & ~dot
        sound &= (fit.x >= 0) & (fit.x <= sky.width - 1)
        sound &= (fit.y >= 0) & (fit.y <= sky.height - 1)
        slack = 3 / matched
        # through a window wider than the star, noise changes the width more
        loose = slack * np.sqrt(squared_widths(window).prod(1) / squared_widths(shape).prod(1))
        wide = (widths[:, 1] > WIDE + loose - slack) & ~full
        sound &= full | (widths[:, 0] > 0.45 - loose)
        sound &= ~wide | ((widths[:, 0] < NARROW) & (matched > CERTAIN))
        blended = (fit.foreign > 0.05 * fit.flux) | (misfit > STRANGE) | wide
        elongated = (widths[:, 1] / np.maximum(widths[:, 0], 0.1) > 1.35 + slack) & ~full & ~edge
    flags = SATURATED * full + EDGE * edge + ELONGATED * elongated + BLENDED * blended
    rows = np.empty(np.count_nonzero(sound), MEASURED)
    for name, column in (
        ("x", fit.x),
        ("y", fit.y),
        ("flux", fit.flux),
        ("snr", snr),
        ("chi2", fit.chi2),
        ("covariance", c),
        ("flags", flags),
        ("wide", wide),
    ):
        rows[name] = column[sound]
    return rows


def _any_within(
    pixels: np.ndarray, left: np.ndarray, top: np.ndarray, axes: np.ndarray, widths: float
) -> np.ndarray:
    """Whether one of the pixels, (N, S, S) bool, lies within the given number of widths from its star: (N,) bool.

    left, top (N,) px: first column and row of a stamp, from the centre of the star; axes: as in LocalPsf.
    """
    if not pixels.any():
        return np.zeros(len(pixels), bool)
    # much faster than nonzero() of three axes
    star, row, column = np.unravel_index(np.flatnonzero(pixels), pixels.shape)
    way = np.stack([left[star] + column, top[star] + row], 1)[..., None]
    # one PSF serves all stars
    near = np.hypot(*(axes[star % len(axes)] @ way).T[0]) < widths
    found = np.zeros(len(pixels), bool)
    found[star[near]] = True
    return found


def _own_light(stamps: Stamps, fit: Fit) -> np.ndarray:
    """The signals (N, S, S) with the model in pixels that say nothing about the star's own shape.

    These are spikes, a SPECK of outliers, and loud ones, as on a streak.
    """
    lost = stamps.spike | (stamps.noise > LOUD * stamps.noise.min((1, 2), keepdims=True))
    if fit.outlier.any():
        lost |= fit.outlier & (np.count_nonzero(fit.outlier, axis=(1, 2)) <= SPECK)[:, None, None]
    return np.where(lost, fit.model, stamps.signal) if lost.any() else stamps.signal


def _misfit(fit: Fit) -> np.ndarray:
    """Factors (N,) on the covariance: chi2 where it is above what chance allows, else 1."""
    freedom = np.maximum(fit.pixels - 3, 1)
    return np.where(fit.chi2 > 1 + 4 * np.sqrt(2 / freedom), fit.chi2, 1.0)


def _without_spikes(stamps: Stamps, lesson: Lesson) -> Stamps:
    """The stamps with the mean of their neighbours in pixels that are much brighter than these, as in no star."""
    beside = np.full(len(stamps.x), -1.0)
    star = lesson.psf.at(stamps.x, stamps.y).evaluate(beside, beside, 3)
    top, four = star[:, 1, 1], (star[:, 0, 1] + star[:, 2, 1] + star[:, 1, 0] + star[:, 1, 2]) * 0.25
    # at least 1, because a ring has a dark middle
    sharpest = SPIKE * np.maximum(1.0, top / np.maximum(four, 1e-3 * np.abs(top))).astype(np.float32)
    gain = lesson.response.gain.astype(np.float32)
    spike = replace_spikes(stamps.signal, stamps.noise, stamps.good, stamps.phase, gain, sharpest, OUTLIER)
    return replace(stamps, spike=spike)


def _is_dot(stamps: Stamps, fit: Fit, response: Response) -> np.ndarray:
    """Whether stars (N,) are hot pixels or sharp cosmic rays: one pixel on the sky describes them better than the PSF.

    Where one pixel does not describe them well either (a star on coarse pixels), the PSF must be twice as bad.
    """
    one, star, pixels, full = compare_with_pixel(
        stamps.signal, stamps.noise, stamps.good, stamps.full, fit.residual, fit.model, response.dn_per_photon,
        response.misfit, max(2, stamps.reach // 2 - 1),
    )  # fmt: skip
    likely = one < pixels + 4 * np.sqrt(2 * pixels)
    return (one < star) & (likely | (one < 0.5 * star)) & (full < SPECK)


def resolve(stars: np.ndarray, psf: Psf) -> np.ndarray:
    """Sort measured stars by flux, keep one of several fits of the same star, and flag close neighbours as BLENDED.

    A wide image is kept only if no better one was measured there.
    """
    stars = stars[np.argsort(-stars["flux"], kind="stable")]
    if not len(stars):
        return stars
    wide = stars["wide"]
    # in widths of the PSF
    points = np.stack([stars["x"], stars["y"]], 1) @ psf.axes.T
    # the brighter star of each pair first
    pairs = spatial.cKDTree(points).query_pairs(FAR, output_type="ndarray")
    apart = np.hypot(*(points[pairs[:, 0]] - points[pairs[:, 1]]).T)
    ratio = stars["flux"][pairs[:, 1]] / stars["flux"][pairs[:, 0]]
    keep = np.ones(len(stars), bool)
    for one, other in (pairs.T, pairs.T[::-1]):
        keep[one[wide[one] & ~wide[other] & (apart < RESOLVED)]] = False
    keep[pairs[keep[pairs[:, 0]] & ((apart < 1.5) | (ratio < 0.01)), 1]] = False
    near = keep[pairs].all(1) & (apart < RESOLVED)
    stars["flags"][pairs[near, 1]] |= BLENDED
    stars["flags"][pairs[near & (ratio > 0.03), 0]] |= BLENDED
    return stars[keep]

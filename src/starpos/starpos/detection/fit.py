# SPDX-License-Identifier: Apache-2.0
"""Weighted least-squares fits of many stars at once with the frame's PSF: one star in each image, or two."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from typing import TypeVar

import numpy as np

from starpos.detection._fit import fitted
from starpos.detection._pairs import fitted_pairs
from starpos.detection._rules import Rules
from starpos.detection._vetting import brightest_left, counted
from starpos.detection.psf import FieldPsf, LocalPsf
from starpos.detection.stamps import Stamps

# Sigmas above the model, and that share of the star's brightest pixel, from which a pixel is not the star's alone.
OUTLIER, FAINT = 6.0, 0.15
# Radius of the fit in widths of the star; farther out there are only noise and neighbours.
FIT_WIDTHS = 4.0
# Sigmas that a fit may be from the place that more rounds would find: of 26 000 simulated stars none was 0.01 off.
SETTLED = 5e-4


@dataclass(frozen=True, eq=False)
class Response:
    """The sensor's response to light: s DN add the variance dn_per_photon s + (misfit s)^2 DN2.

    gain           (P,) relative sensitivity of each phase of the colour mosaic, mean 1; (1,) without a mosaic
    colour_spread  relative scatter (1 sigma) of one star's gains about these, because stars have colours
    dn_per_photon  DN of one photon, for the photon noise
    misfit         share of the light that the PSF describes wrongly
    """

    gain: np.ndarray
    colour_spread: float
    dn_per_photon: float
    misfit: float

    @property
    def rules(self) -> Rules:
        """The rules by which compiled code fits stars."""
        return Rules(
            self.gain,
            self.colour_spread,
            self.dn_per_photon,
            self.misfit,
            FIT_WIDTHS,
            OUTLIER,
            FAINT,
            SETTLED,
        )

    def variance(self, noise: np.ndarray, light: np.ndarray) -> np.ndarray:
        """Variance, DN2, of pixels with the sky's noise (DN) and a star's light (DN) on them."""
        light = np.maximum(light, 0)
        return noise**2 + np.float32(self.dn_per_photon) * light + np.float32(self.misfit**2) * light**2


@dataclass(frozen=True, eq=False, kw_only=True)
class Fit:
    """N fitted stars.

    x, y              (N,) px
    flux, flux_sigma  (N,) DN
    covariance        (N, 2, 2) px2 of x, y
    gains             (N, P): sensitivity of each phase of the mosaic to each star's light
    chi2              (N,) per degree of freedom
    pixels            (N,) how many pixels took part in the fit
    residual          (N, S, S) DN: signal minus model
    model             (N, S, S) DN; 0 beyond FIT_WIDTHS, unless the whole is asked for
    used              (N, S, S) bool: pixels that took part in the fit
    outlier           (N, S, S) bool: pixels left out because they are much too bright for this star
    leverage          (N, S, S), 0..1: a residual's variance is (1 - leverage) times the noise's; empty if not
                      asked for
    """

    x: np.ndarray
    y: np.ndarray
    flux: np.ndarray
    flux_sigma: np.ndarray
    covariance: np.ndarray
    gains: np.ndarray
    chi2: np.ndarray
    pixels: np.ndarray
    residual: np.ndarray
    model: np.ndarray
    used: np.ndarray
    outlier: np.ndarray
    leverage: np.ndarray


COLUMNS = tuple(f.name for f in fields(Fit))


def fit_stars(
    stamps: Stamps,
    psf: FieldPsf,
    x: np.ndarray,
    y: np.ndarray,
    response: Response,
    rounds: int = 5,
    leverage: bool = False,
    whole: bool = False,
) -> Fit:
    """Fit stars by Gauss-Newton, starting at the points x, y (N,) px.

    The leverage of pixels and the model of the whole stamp are returned if asked for.

    On a mosaic nothing is interpolated: each pixel is compared with the PSF at its own place, times the gain of its
    colour. Each star's four gains are fitted too, held near the frame's by colour_spread, so that neither the mosaic's
    phase nor the star's colour moves the position. The weights come from the model: the pixels' own noise would bias
    the fit.
    """
    local = psf.at(x, y)
    columns = fitted(
        stamps.signal, stamps.noise, stamps.good, stamps.phase, stamps.x, stamps.y, x, y, local.axes, local.series,
        response.rules, rounds, leverage, whole,
    )  # fmt: skip
    return Fit(**dict(zip(COLUMNS, columns, strict=True)))


def gains_at(gains: np.ndarray, phase: np.ndarray) -> np.ndarray:
    """The gain float32 of each pixel: stars' gains (N, P) at the pixels' phases (N, S, S); (N, 1, 1) without a mosaic."""
    if gains.shape[1] == 1:
        return gains.astype(np.float32)[:, :, None]
    return gains.astype(np.float32)[np.arange(len(gains))[:, None, None], phase]


# Minimum excess of chi-square over a single star's, in sigma, at which a companion is tried.
SURPRISING = 4.0
# Widths of the PSF: closer pairs cannot be separated.
CLOSEST = 1.5
# SNR a companion must have.
FAINTEST = 5.0
# Minimum decrease of the sum of squares by a companion, over chi-square per pixel (it adds three parameters).
GAIN = 30.0
# Companions fainter than this share of the star may be faults of the PSF.
DIMMEST = 0.03
ROUNDS = 10
# It is looked for at least so far (px) from the star, with a Gaussian of 0.8 px, from its middle outwards.
NEAREST_PX, SMOOTHING = 1.0, np.exp(-0.5 * (np.arange(4) / 0.8) ** 2)
SMOOTHING /= 2 * SMOOTHING.sum() - SMOOTHING[0]
# One step of the fit never leaves a star less than this share of its flux.
LEAST = 0.05

Rows = TypeVar("Rows", Fit, Stamps)
# Stars with stamps, which of their pixels have the mean of their neighbours (N, S, S), and fits.
Fitted = tuple[Stamps, np.ndarray, Fit]


@dataclass(frozen=True, eq=False, kw_only=True)
class Pairs:
    """N pairs of stars fitted together; the first axis is the star, 0 or its companion 1.

    x, y, flux, flux_sigma  (2, N) px and DN
    gains                   (2, N, P): gains of the mosaic's phases
    covariance              (2, N, 2, 2) px2 of x, y
    models                  (2, N, S, S) DN
    used                    (N, S, S) bool: pixels that took part
    chi2                    (N,): the whole chi-square
    """

    x: np.ndarray
    y: np.ndarray
    flux: np.ndarray
    flux_sigma: np.ndarray
    gains: np.ndarray
    covariance: np.ndarray
    models: np.ndarray
    used: np.ndarray
    chi2: np.ndarray


def pairs_among(
    stars: Fitted,
    psf: FieldPsf,
    response: Response,
    cut_at: Callable[[np.ndarray, np.ndarray], tuple[Stamps, np.ndarray]],
) -> tuple[np.ndarray, Fitted | None]:
    """Which of N surprising stars have companions, (N,) bool; and these stars, then the companions, if there are any.

    Each star's stamp is without the other's light. cut_at(x, y) gives the Stamps around pixels x, y (N,) and which of
    their pixels are spikes (N, S, S).
    """
    crowd, spike, alone = stars
    light = _light(crowd, psf, alone.x, alone.y, alone.flux, alone.gains)
    alone = replace(alone, model=light, residual=crowd.signal - light)
    real, pairs = _real_pairs(crowd, alone, psf, response)
    if not real.any():
        return real, None
    both, models, chi2 = crowd.take(real), pairs.models, pairs.chi2 / _freedom(pairs)
    one, other = (
        {name: getattr(pairs, name)[k] for name in ("x", "y", "flux", "flux_sigma", "covariance", "gains")}
        for k in (0, 1)
    )
    first = replace(
        rows_of(alone, real), **one, chi2=chi2, pixels=_pixels(pairs), residual=both.signal - models.sum(0),
        model=models[0], used=pairs.used, outlier=np.zeros_like(pairs.used),
    )  # fmt: skip
    first_stamps = replace(both, signal=both.signal - models[1])
    second_stamps, second_spike = cut_at(np.rint(other["x"]).astype(int), np.rint(other["y"]).astype(int))
    light = _light(second_stamps, psf, one["x"], one["y"], one["flux"], one["gains"])
    noise = np.sqrt(response.variance(second_stamps.noise, light))
    second_stamps = replace(second_stamps, signal=second_stamps.signal - light, noise=noise)
    second = fit_stars(second_stamps, psf, other["x"], other["y"], response, rounds=3)
    # if the whole companion lies on the first star's stamp, the fit of both together is the better one
    whole = _away(both, pairs)[1] < both.reach - 1
    together = other | {"chi2": chi2}
    for name, value in together.items():
        own = getattr(second, name)
        together[name] = np.where(whole.reshape(-1, *[1] * (own.ndim - 1)), value, own)
    return real, (
        joined([first_stamps, second_stamps]),
        np.concatenate([spike[real], second_spike]),
        joined([first, replace(second, **together)]),
    )


def _real_pairs(stamps: Stamps, alone: Fit, psf: FieldPsf, response: Response) -> tuple[np.ndarray, Pairs]:
    """Which of N stars, fitted alone, have companions, (N,) bool, and the Pairs of those that have."""
    pairs = _fit_pairs(stamps, alone, psf, response)
    x, y, flux = pairs.x, pairs.y, pairs.flux
    apart = np.hypot(*(psf.at(x[0], y[0]).axes @ np.stack([x[1] - x[0], y[1] - y[0]], 1)[..., None]).T[0])
    away = _away(stamps, pairs)
    before = stamps.good * pairs.used * alone.residual**2 / response.variance(stamps.noise, alone.model)
    with np.errstate(invalid="ignore"):
        real = (flux > FAINTEST * pairs.flux_sigma).all(0) & np.isfinite(pairs.chi2) & (apart > CLOSEST)
        real &= (away[0] < stamps.reach - 1) & (away[1] < stamps.reach + 2)
        real &= before.sum((1, 2)) - pairs.chi2 > GAIN * np.maximum(pairs.chi2 / _freedom(pairs), 1)
        real &= flux[1] > DIMMEST * flux[0]
    of_stars = ("used", "chi2")
    return real, Pairs(
        **{
            f.name: getattr(pairs, f.name)[real if f.name in of_stars else (slice(None), real)]
            for f in fields(Pairs)
        }
    )


def _pixels(pairs: Pairs) -> np.ndarray:
    """How many pixels (N,) took part in the fits."""
    return pairs.used.sum((1, 2))


def _freedom(pairs: Pairs) -> np.ndarray:
    """Degrees of freedom (N,) of the fits."""
    return np.maximum(_pixels(pairs) - 6, 1)


def _away(stamps: Stamps, pairs: Pairs) -> np.ndarray:
    """How far both stars (2, N) are from the middles of their stamps, px along the farther axis."""
    return np.maximum(np.abs(pairs.x - stamps.x), np.abs(pairs.y - stamps.y))


def surprising(stamps: Stamps, fit: Fit) -> np.ndarray:
    """Whether stars (N,) leave more light unexplained than a single star does."""
    freedom = np.maximum(fit.pixels - 3, 1)
    with np.errstate(invalid="ignore"):
        odd = (fit.chi2 > 1 + SURPRISING * np.sqrt(2 / freedom)) | (counted(fit.outlier) > 2)
    return odd & (counted(stamps.full) == 0) & np.isfinite(fit.covariance).all((1, 2)) & (fit.flux > 0)


def _light(
    stamps: Stamps, psf: FieldPsf, x: np.ndarray, y: np.ndarray, flux: np.ndarray, gains: np.ndarray
) -> np.ndarray:
    """The light (N, S, S) float32, DN, of stars at x, y (N,) px, with flux (N,) and gains (N, P), on whole stamps."""
    light = psf.at(x, y).evaluate(*stamps.corner(x, y), stamps.size)
    return light * (gains_at(gains, stamps.phase) * flux.astype(np.float32)[:, None, None])


def _fit_pairs(stamps: Stamps, fit: Fit, psf: FieldPsf, response: Response) -> Pairs:
    """Fit a star and a companion to each stamp by Gauss-Newton on all their parameters.

    The companion starts where the single star's fit leaves the most light.
    """
    local = psf.at(fit.x, fit.y)
    first = np.stack([np.stack([fit.x, fit.y], 1), np.stack(_brightest_left(stamps, fit, local), 1)])
    columns = fitted_pairs(
        stamps.signal, stamps.noise, stamps.good, stamps.phase, stamps.x, stamps.y, first, LEAST * fit.flux,
        local.axes, local.series, response.rules, ROUNDS, LEAST,
    )  # fmt: skip
    return Pairs(**dict(zip((f.name for f in fields(Pairs)), columns, strict=True)))


def _brightest_left(stamps: Stamps, fit: Fit, psf: LocalPsf) -> tuple[np.ndarray, np.ndarray]:
    """Pixel x, y (N,) px, off the star's centre, where the fit leaves the most light."""
    row, column = brightest_left(
        fit.residual,
        stamps.good,
        *stamps.corner(fit.x, fit.y),
        psf.axes,
        NEAREST_PX,
        FIT_WIDTHS + 2,
        SMOOTHING,
    )
    return stamps.x + column - stamps.reach, stamps.y + row - stamps.reach


def rows_of(fit: Fit, index: np.ndarray) -> Fit:
    """The rows `index` of a Fit."""
    return Fit(**{f.name: getattr(fit, f.name)[index] for f in fields(Fit)})


def joined(parts: Sequence[Rows]) -> Rows:
    """The rows of dataclasses of arrays, one after the other."""
    if len(parts) == 1:
        return parts[0]
    rows = {f.name: np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(parts[0])}
    return replace(parts[0], **rows)

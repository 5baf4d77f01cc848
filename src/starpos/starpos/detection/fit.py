# SPDX-License-Identifier: Apache-2.0
"""Weighted least-squares fits of many stars at once with the frame's PSF: one star in each image, or two."""

from collections.abc import Callable
from dataclasses import dataclass, fields, replace

import numpy as np
from scipy import ndimage

from starpos.detection._fit import Rules, fit_stamps
from starpos.detection.psf import Psf
from starpos.detection.stamps import Stamps
from starpos.frozen import ArrayRows, joined

# Sigmas above the model, and that share of the star's brightest pixel, from which a pixel is not the star's alone.
OUTLIER, FAINT = 6.0, 0.15
# Radius of the fit in widths of the star; farther out there are only noise and neighbours.
FIT_WIDTHS = 4.0
# Sigmas that a fit may be from the place that more rounds would find: of 26 000 simulated stars none was 0.01 off.
SETTLED = 5e-4
# Rounds of the fit of pairs; one step never leaves a star of a pair less than this share of its flux.
PAIR_ROUNDS, LEAST = 10, 0.05


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
class Fit(ArrayRows):
    """N fitted stars.

    x, y              (N,) px
    flux, flux_sigma  (N,) DN
    covariance        (N, 2, 2) px2 of x, y
    gains             (N, P): sensitivity of each phase of the mosaic to each star's light
    chi2              (N,) per degree of freedom
    pixels            (N,) how many pixels took part in the fit
    residual          (N, S, S) DN: signal minus model
    model             (N, S, S) DN; of a pair; else 0 beyond FIT_WIDTHS
    used              (N, S, S) bool: pixels that took part in the fit
    outlier           (N, S, S) bool: pixels left out because they are much too bright for this star
    leverage          (N, S, S), 0..1: a residual's variance is (1 - leverage) times the noise's; empty if not
                      asked for
    sky_snr           (N,) SNR in the sky's noise alone
    foreign           (N,) DN: light of the outliers beyond the model
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
    sky_snr: np.ndarray
    foreign: np.ndarray


# Columns of a Fit, and whether each of several stars in one stamp has its own; the others are the stamp's.
COLUMNS = {
    f.name: f.name in ("x", "y", "flux", "flux_sigma", "covariance", "gains", "model", "sky_snr")
    for f in fields(Fit)
}


def fit_stars(
    stamps: Stamps,
    psf: Psf,
    x: np.ndarray,
    y: np.ndarray,
    response: Response,
    rounds: int = 5,
    leverage: bool = False,
) -> Fit:
    """Fit stars by Gauss-Newton, starting at the points x, y (N,) px.

    The leverage of pixels is returned if asked for.

    On a mosaic nothing is interpolated: each pixel is compared with the PSF at its own place, times the gain of its
    colour. Each star's four gains are fitted too, held near the frame's by colour_spread, so that neither the mosaic's
    phase nor the star's colour moves the position. The weights come from the model: the pixels' own noise would bias
    the fit.
    """
    first = np.ascontiguousarray(x)[None], np.ascontiguousarray(y)[None]
    return _fit(stamps, psf, *first, response, rounds, leverage, False)[0]


def fit_pairs(
    stamps: Stamps, psf: Psf, places: np.ndarray, flux: np.ndarray, response: Response
) -> list[Fit]:
    """Fit a pair of stars to each of N stamps by Gauss-Newton on all their parameters.

    The PSF is taken at the first places.

    places  (2, 2, N) px: first x, y of the stars and of their companions
    flux    (N,) DN: of the star alone

    Returns two Fits, with models of the whole stamps, and chi2, residual and pixels of both together.
    """
    return _fit(stamps, psf, *places, response, PAIR_ROUNDS + 1, False, True, LEAST * flux, LEAST)


def _fit(
    stamps: Stamps, psf: Psf, x: np.ndarray, y: np.ndarray, response: Response, *settings: object
) -> list[Fit]:
    """Fits of K stars to each of N stamps, with first places x, y (K, N) px."""
    local = psf.at(x[0], y[0])
    columns = fit_stamps(
        stamps.signal, stamps.noise, stamps.good, stamps.phase, stamps.x, stamps.y, x, y, local.axes, local.series,
        response.rules, *settings,
    )  # fmt: skip
    return [
        Fit(**{name: c[k] if own else c for (name, own), c in zip(COLUMNS.items(), columns, strict=True)})
        for k in range(len(x))
    ]


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
# It is looked for at least so far (px) from the star, with a Gaussian of this sigma (px).
NEAREST_PX, SMOOTHED_PX = 1.0, 0.8


def split_pairs(
    stamps: Stamps,
    alone: Fit,
    psf: Psf,
    response: Response,
    cut_at: Callable[[np.ndarray, np.ndarray], Stamps],
) -> tuple[np.ndarray, tuple[Stamps, Fit] | None]:
    """Which of N surprising stars have companions, (N,) bool; and these stars, then the companions, if there are any.

    Each star's stamp is without the other's light. cut_at(x, y) gives the Stamps around pixels x, y (N,).
    """
    light = _model_light(stamps, psf, alone)
    alone = replace(alone, model=light, residual=stamps.signal - light)
    first, second = fit_pairs(stamps, psf, _first_places(stamps, alone, psf), alone.flux, response)
    real = _are_real(stamps, alone, first, second, psf, response)
    if not real.any():
        return real, None
    both, first, second = stamps.select(real), first.select(real), second.select(real)
    x, y = (np.rint(v).astype(int) for v in (second.x, second.y))
    around = cut_at(x, y)
    light = _model_light(around, psf, first)
    noise = np.sqrt(response.variance(around.noise, light))
    around = replace(around, signal=around.signal - light, noise=noise)
    apart = fit_stars(around, psf, second.x, second.y, response, rounds=3)
    # if the whole companion lies on the first star's stamp, the fit of both together is the better one
    whole = _off_centre_px(both, second) < both.reach - 1
    better = {}
    for name in ("x", "y", "flux", "flux_sigma", "covariance", "gains", "chi2"):
        own = getattr(apart, name)
        better[name] = np.where(whole.reshape(-1, *[1] * (own.ndim - 1)), getattr(second, name), own)
    return real, (
        joined([replace(both, signal=both.signal - second.model), around]),
        joined([first, replace(apart, **better)]),
    )


def _are_real(
    stamps: Stamps, alone: Fit, first: Fit, second: Fit, psf: Psf, response: Response
) -> np.ndarray:
    """Which of N stars, fitted alone and then with companions, have these, (N,) bool."""
    way = np.stack([second.x - first.x, second.y - first.y], 1)[..., None]
    apart = np.hypot(*(psf.at(first.x, first.y).axes @ way).T[0])
    freedom = np.maximum(first.pixels - 6, 1)
    before = stamps.good * first.used * alone.residual**2 / response.variance(stamps.noise, alone.model)
    with np.errstate(invalid="ignore"):
        real = np.isfinite(first.chi2) & (apart > CLOSEST)
        for fit, beyond in ((first, -1), (second, 2)):
            real &= (fit.flux > FAINTEST * fit.flux_sigma) & (
                _off_centre_px(stamps, fit) < stamps.reach + beyond
            )
        real &= before.sum((1, 2)) - first.chi2 * freedom > GAIN * np.maximum(first.chi2, 1)
        return real & (second.flux > DIMMEST * first.flux)


def _off_centre_px(stamps: Stamps, fit: Fit) -> np.ndarray:
    """How far stars (N,) are from the middles of their stamps, px along the farther axis."""
    return np.maximum(np.abs(fit.x - stamps.x), np.abs(fit.y - stamps.y))


def surprising(stamps: Stamps, fit: Fit) -> np.ndarray:
    """Whether stars (N,) leave more light unexplained than a single star does."""
    freedom, outliers = np.maximum(fit.pixels - 3, 1), np.count_nonzero(fit.outlier, axis=(1, 2))
    with np.errstate(invalid="ignore"):
        odd = (fit.chi2 > 1 + SURPRISING * np.sqrt(2 / freedom)) | (outliers > 2)
    return odd & ~stamps.full.any((1, 2)) & np.isfinite(fit.covariance).all((1, 2)) & (fit.flux > 0)


def _model_light(stamps: Stamps, psf: Psf, fit: Fit) -> np.ndarray:
    """The light (N, S, S) float32, DN, of fitted stars on whole stamps."""
    light = psf.at(fit.x, fit.y).evaluate(*stamps.corner(fit.x, fit.y), stamps.size)
    return light * (gains_at(fit.gains, stamps.phase) * fit.flux.astype(np.float32)[:, None, None])


def _first_places(stamps: Stamps, fit: Fit, psf: Psf) -> np.ndarray:
    """First places (2, 2, N) px of pairs: the star's, and the pixel off its centre where its fit leaves most light."""
    smoothing = ndimage.gaussian_filter1d(np.eye(stamps.size, dtype=np.float32), SMOOTHED_PX, 0)
    light = smoothing @ (fit.residual * stamps.good) @ smoothing.T
    (left, top), grid = stamps.corner(fit.x, fit.y), np.arange(stamps.size)
    dx, dy = (left[:, None] + grid)[:, None], (top[:, None] + grid)[..., None]
    u, v = (
        i[:, None, None] * dx + j[:, None, None] * dy for i, j in psf.at(fit.x, fit.y).axes.transpose(1, 2, 0)
    )
    light[(dx * dx + dy * dy < NEAREST_PX**2) | (u * u + v * v >= (FIT_WIDTHS + 2) ** 2)] = -np.inf
    row, column = np.divmod(light.reshape(len(light), -1).argmax(1), stamps.size)
    left, top = stamps.x - stamps.reach, stamps.y - stamps.reach
    return np.array([[fit.x, left + column], [fit.y, top + row]])

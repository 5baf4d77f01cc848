# SPDX-License-Identifier: Apache-2.0
"""Weighted least-squares fit of position and flux of many stars at once, with the frame's PSF."""

from dataclasses import dataclass, fields

import numpy as np

from starpos.detection._fit import fitted
from starpos.detection._rules import Rules
from starpos.detection.psf import FieldPsf
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

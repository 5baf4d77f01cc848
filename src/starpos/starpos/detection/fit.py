# SPDX-License-Identifier: Apache-2.0
"""Weighted least-squares fit of position and flux of many stars at once, with the frame's PSF."""

from dataclasses import dataclass

import numpy as np

OUTLIER = 6.0  # sigma
FIT_WIDTHS = 4.0  # fit what lies within so many widths of the star: beyond is only noise and neighbours


@dataclass(frozen=True, eq=False)
class Response:
    """How light becomes DN, and noise.

    gain           (P,) what each phase of the colour mosaic passes, mean 1; (1,) without a mosaic
    colour_spread  how far a star's own gains scatter about these, relative, 1 sigma: stars have colours
    dn_per_photon  a signal of s DN has the variance dn_per_photon * s + (misfit * s)^2 DN2 on top of the sky's:
    misfit         photons, and what the frame's one PSF fails to describe
    """

    gain: np.ndarray
    colour_spread: float
    dn_per_photon: float
    misfit: float

    @property
    def own_gains(self) -> int:
        """How many gains a star has of its own: P, or none without a mosaic."""
        return len(self.gain) if len(self.gain) > 1 else 0

    def columns(self, shape, amount, own, phase):
        """How pixels (N, S, S) change with a star's x, y, flux and own gains: a list.

        shape, amount, own: what LocalPsf.evaluate tells of them; the star's flux and its gains there.
        """
        value, by_x, by_y = shape
        gain = self.gain.astype(np.float32)
        by_gain = [amount * value * np.where(phase == p, gain[p], 0) for p in range(self.own_gains)]
        return [amount * by_x * own, amount * by_y * own, value * own, *by_gain]

    def hold(self, normal, right, colour):
        """Adds to normal equations of these columns, in place, how near the mean stars' own gains are."""
        for p in range(self.own_gains):
            normal[:, 3 + p, 3 + p] += self.colour_spread**-2
            right[:, 3 + p] -= colour[:, p] * self.colour_spread**-2

    def variance(self, noise, light):
        """DN2 of pixels with the sky's noise (DN) and light DN of a star on them."""
        light = np.maximum(light, 0)
        return noise**2 + np.float32(self.dn_per_photon) * light + np.float32(self.misfit**2) * light**2


@dataclass(frozen=True, eq=False, kw_only=True)
class Fit:
    """N fitted stars: x, y px; flux DN and its sigma; covariance (N, 2, 2) px2 of x, y; chi2 per degree of freedom.

    gains (N, P): what each phase of the mosaic passes of each star's light;
    residual, model (N, S, S): signal minus model, and the model, DN; used (N, S, S): which pixels took part;
    outlier (N, S, S): which did not, much too bright for this star;
    leverage (N, S, S): how much of its own noise each pixel explains, 0..1, so a residual's variance is 1 - leverage
    of the noise's.
    """

    x: np.ndarray
    y: np.ndarray
    flux: np.ndarray
    flux_sigma: np.ndarray
    covariance: np.ndarray
    gains: np.ndarray
    chi2: np.ndarray
    residual: np.ndarray
    model: np.ndarray
    used: np.ndarray
    outlier: np.ndarray
    leverage: np.ndarray


def fit_stars(stamps, psf, x, y, response, rounds=5) -> Fit:
    """Gauss-Newton from the points x, y (N,).

    On a mosaic nothing is interpolated: each pixel is compared with the PSF at its own place, times the gain of its
    colour, and each star's four gains are fitted along, held near the frame's by colour_spread. So a position owes
    nothing to the mosaic's phase nor to the star's colour. The weights come from the model, not from the pixels,
    whose noise would otherwise pull the fit.
    """
    x, y, local = x.copy(), y.copy(), psf.at(x, y)
    n = len(x)
    inverse_noise2 = stamps.good / stamps.noise**2
    colour = np.zeros((n, len(response.gain)))  # each star's gains over the frame's, minus 1
    own = gains_at(response.gain * (1 + colour), stamps.phase)
    flux = np.full(n, np.nan)
    outlier = np.zeros(stamps.signal.shape, bool)
    for round_ in range(rounds):
        last = round_ == rounds - 1
        dx, dy = stamps.offsets(x, y)
        shape = local.evaluate(dx, dy)
        inside = local.within(dx, dy, FIT_WIDTHS)
        unit = shape[0] * own
        if not np.isfinite(flux).all():
            weight = inverse_noise2 * inside
            with np.errstate(divide="ignore", invalid="ignore"):
                flux = (weight * unit * stamps.signal).sum((1, 2)) / (weight * unit * unit).sum((1, 2))
            flux = np.nan_to_num(flux)
        amount = flux.astype(np.float32)[:, None, None]
        variance = response.variance(stamps.noise, amount * unit)
        used = stamps.good & inside & ~outlier
        root = np.sqrt(used / variance)
        columns = response.columns(shape, amount, own, stamps.phase)
        design = np.stack([(c * root).reshape(n, -1) for c in columns], 2)
        residual = stamps.signal - amount * unit
        normal = (design.transpose(0, 2, 1) @ design).astype(np.float64)
        right = (design.transpose(0, 2, 1) @ (residual * root).reshape(n, -1, 1))[..., 0].astype(np.float64)
        response.hold(normal, right, colour)
        covariance = inverse(normal)
        if last:
            break
        if round_ >= 1:
            # a hot pixel or a neighbour's light: much too bright for the noise and for an imperfect PSF
            outlier = (residual > OUTLIER * np.sqrt(variance)) & (
                residual > 0.15 * amount * unit.max((1, 2), keepdims=True)
            )
        step = (covariance @ right[..., None])[..., 0]
        x += np.clip(step[:, 0], -1, 1)
        y += np.clip(step[:, 1], -1, 1)
        flux += step[:, 2]
        if response.own_gains:
            colour = np.clip(colour + step[:, 3:], -0.9, 3.0)
            own = gains_at(response.gain * (1 + colour), stamps.phase)
    freedom = np.maximum(used.sum((1, 2)) - 3, 1)
    chi2 = ((residual * root) ** 2).sum((1, 2)) / freedom
    leverage = ((design @ np.nan_to_num(covariance).astype(np.float32)) * design).sum(2).reshape(used.shape)
    with np.errstate(divide="ignore"):
        # at known place and colour, of which the star's detection owes nothing; a root is rounded alike wherever an array
        # lies in memory, numpy 1.26's power is not, and the answers of several processes are to be the same
        flux_sigma = 1 / np.sqrt(normal[:, 2, 2])
    return Fit(
        x=x,
        y=y,
        flux=flux,
        flux_sigma=flux_sigma,
        covariance=covariance[:, :2, :2],
        gains=response.gain * (1 + colour),
        chi2=chi2,
        residual=residual,
        model=amount * unit,
        used=used,
        outlier=outlier & stamps.good & inside,
        leverage=leverage,
    )


def gains_at(gains, phase):
    """(N, S, S) float32: of stars' gains (N, P) those of pixels of these phases."""
    return gains.astype(np.float32)[np.arange(len(gains))[:, None, None], phase]


def inverse(normal):
    """Inverses of (N, K, K), NaN where singular; scaled first, since fluxes and pixels differ by a millionfold."""
    scale = np.sqrt(np.einsum("nii->ni", normal))
    with np.errstate(divide="ignore", invalid="ignore"):
        scaled = normal / (scale[:, :, None] * scale[:, None, :])
    sound = np.isfinite(scaled).all((1, 2))
    sound[sound] = np.linalg.det(scaled[sound]) > 1e-9
    out = np.full(normal.shape, np.nan)
    out[sound] = np.linalg.inv(scaled[sound]) / (scale[:, :, None] * scale[:, None, :])[sound]
    return out

# SPDX-License-Identifier: Apache-2.0
"""Two stars in one image: what a single one leaves unexplained is tried as a companion, both fitted at once."""

from dataclasses import fields, replace

import numpy as np
from scipy import ndimage

from starpos.detection.fit import FIT_WIDTHS, Fit, fit_stars, gains_at, inverse
from starpos.detection.stamps import Stamps

SURPRISING = 4.0  # sigma of chi-square: from here on one star is not enough
CLOSEST = 1.5  # widths: nearer ones are not told apart
FAINTEST = 5.0  # sigma of a companion's flux
GAIN = 30.0  # a companion's three numbers must take so much off the sum of squares, of chi-square per pixel
DIMMEST = 0.03  # of the other's flux: below it the PSF's own faults look like companions
ROUNDS = 10
LEAST = 0.05  # of a star's flux is left by a step of the fit, whatever it asks for


def with_companions(stamps, spike, fit, psf, response, cut_at):
    """stamps, spike and fit with companions as further rows, the light of the other off each.

    cut_at(x, y) gives the stamps around pixels, and which of their pixels are spikes.
    """
    odd = np.flatnonzero(_surprising(stamps, fit))
    if len(odd) == 0:
        return stamps, spike, fit
    before = (stamps.good * fit.residual**2 / response.variance(stamps.noise, fit.model))[odd]
    x, y, flux, gains, sigma, covariance, models, used, chi2 = _fit_pairs(
        stamps.take(odd), _rows(fit, odd), psf, response
    )
    freedom = np.maximum(used.sum((1, 2)) - 6, 1)
    apart = np.hypot(*(psf.at(x[0], y[0]).axes @ np.stack([x[1] - x[0], y[1] - y[0]], 1)[..., None]).T[0])
    away = np.maximum(np.abs(x - stamps.x[odd]), np.abs(y - stamps.y[odd]))
    with np.errstate(invalid="ignore"):
        real = (flux > FAINTEST * sigma).all(0) & np.isfinite(chi2) & (apart > CLOSEST)
        real &= (away[0] < stamps.reach - 1) & (away[1] < stamps.reach + 2)
        real &= (before * used).sum((1, 2)) - chi2 > GAIN * np.maximum(chi2 / freedom, 1)
        real &= flux[1] > DIMMEST * flux[0]
    if not real.any():
        return stamps, spike, fit
    odd, used, whole = odd[real], used[real], away[1, real] < stamps.reach - 1
    x, y, flux, gains, sigma, covariance, models = (
        a[:, real] for a in (x, y, flux, gains, sigma, covariance, models)
    )
    pair = stamps.take(odd)
    first = replace(
        _rows(fit, odd), x=x[0], y=y[0], flux=flux[0], flux_sigma=sigma[0], covariance=covariance[0], gains=gains[0],
        chi2=(chi2 / freedom)[real], residual=pair.signal - models.sum(0), model=models[0], used=used,
        outlier=np.zeros_like(used),
    )  # fmt: skip
    stamps = _with_rows(stamps, odd, replace(pair, signal=pair.signal - models[1]))
    second_stamps, second_spike = cut_at(np.rint(x[1]).astype(int), np.rint(y[1]).astype(int))
    light = psf.at(x[0], y[0]).evaluate(*second_stamps.offsets(x[0], y[0]))[0]
    light *= gains_at(gains[0], second_stamps.phase) * flux[0].astype(np.float32)[:, None, None]
    noise = np.sqrt(response.variance(second_stamps.noise, light))
    second_stamps = replace(second_stamps, signal=second_stamps.signal - light, noise=noise)
    second = fit_stars(second_stamps, psf, x[1], y[1], response, rounds=3)
    # where the first one's stamp held it whole, the fit of both at once knows best
    together = {"x": x[1], "y": y[1], "flux": flux[1], "flux_sigma": sigma[1], "covariance": covariance[1]}
    together |= {"gains": gains[1], "chi2": first.chi2}
    for name, value in together.items():
        own = getattr(second, name)
        together[name] = np.where(whole.reshape(-1, *[1] * (own.ndim - 1)), value, own)
    return (
        _joined(Stamps, stamps, second_stamps),
        np.concatenate([spike, second_spike]),
        _joined(Fit, _with_rows(fit, odd, first), replace(second, **together)),
    )


def _surprising(stamps, fit):
    freedom = np.maximum(fit.used.sum((1, 2)) - 3, 1)
    with np.errstate(invalid="ignore"):
        odd = (fit.chi2 > 1 + SURPRISING * np.sqrt(2 / freedom)) | (fit.outlier.sum((1, 2)) > 2)
    return odd & ~stamps.full.any((1, 2)) & np.isfinite(fit.covariance).all((1, 2)) & (fit.flux > 0)


def _fit_pairs(stamps, fit, psf, response):
    """x, y, flux (2, N), gains (2, N, P), sigma of flux (2, N), covariance (2, N, 2, 2), models (2, N, S, S), used
    (N, S, S) and chi2 (N,) of pairs.

    Gauss-Newton on all their numbers; the companion starts where the most is left.
    """
    n, psf = len(fit.x), psf.at(fit.x, fit.y)
    x, y = (np.stack(v) for v in zip((fit.x, fit.y), _brightest_left(stamps, fit, psf), strict=True))
    colour = np.zeros((2, n, len(response.gain)))
    flux = None
    for round_ in range(ROUNDS + 1):
        places = [stamps.offsets(x[k], y[k]) for k in (0, 1)]
        shapes = [psf.evaluate(*place) for place in places]
        gains = response.gain * (1 + colour)
        own = [gains_at(gains[k], stamps.phase) for k in (0, 1)]
        inside = psf.within(*places[0], FIT_WIDTHS) | psf.within(*places[1], FIT_WIDTHS)
        used = stamps.good & inside
        if flux is None:
            flux = _fluxes(stamps, used, *(shapes[k][0] * own[k] for k in (0, 1)))
            flux = np.maximum(flux, LEAST * fit.flux)
        amount = flux.astype(np.float32)[:, :, None, None]
        columns = [response.columns(shapes[k], amount[k], own[k], stamps.phase) for k in (0, 1)]
        models = np.stack([amount[k] * columns[k][2] for k in (0, 1)])
        root = np.sqrt(used / response.variance(stamps.noise, models.sum(0)))
        design = np.stack([(c * root).reshape(n, -1) for c in (*columns[0], *columns[1])], 2)
        residual = ((stamps.signal - models.sum(0)) * root).reshape(n, -1, 1)
        normal = (design.transpose(0, 2, 1) @ design).astype(np.float64)
        right = (design.transpose(0, 2, 1) @ residual)[..., 0].astype(np.float64)
        each = [slice(k * len(columns[0]), (k + 1) * len(columns[0])) for k in (0, 1)]
        for k in (0, 1):
            response.hold(normal[:, each[k], each[k]], right[:, each[k]], colour[k])
        covariance = inverse(normal)
        if round_ == ROUNDS:
            break
        step = np.nan_to_num(covariance @ right[..., None])[..., 0]
        for k in (0, 1):
            own_step = step[:, each[k]]
            x[k] += np.clip(own_step[:, 0], -0.5, 0.5)
            y[k] += np.clip(own_step[:, 1], -0.5, 0.5)
            # a star without light would stay where it is: its place changes nothing
            flux[k] = np.maximum(flux[k] + own_step[:, 2], LEAST * flux[k])
            if response.own_gains:
                colour[k] = np.clip(colour[k] + own_step[:, 3:], -0.9, 3.0)
    # as of a single star, at known colours
    grey = np.concatenate([np.arange(s.start, s.start + 3) for s in each])
    known = inverse(normal[:, grey[:, None], grey])
    with np.errstate(invalid="ignore"):
        sigma = np.sqrt(np.stack([known[:, 2, 2], known[:, 5, 5]]))
    covariance = np.stack([covariance[:, s, s][:, :2, :2] for s in each])
    return x, y, flux, gains, sigma, covariance, models, used, (residual**2).sum((1, 2))


def _brightest_left(stamps, fit, psf):
    """x, y (N,) px: where off a star the most is left."""
    dx, dy = stamps.offsets(fit.x, fit.y)
    left = ndimage.gaussian_filter(stamps.good * fit.residual, (0, 0.8, 0.8))
    left[(dx**2 + dy**2 < 1) | ~psf.within(dx, dy, FIT_WIDTHS + 2)] = -np.inf
    row, column = np.divmod(left.reshape(len(left), -1).argmax(1), left.shape[2])
    return stamps.x + column - stamps.reach, stamps.y + row - stamps.reach


def _fluxes(stamps, used, a, b):
    """(2, N) by linear least squares in the sky's noise, of stars whose unit images are a, b (N, S, S)."""
    weight = used / stamps.noise**2
    aa, ab, bb, sa, sb = (
        (weight * p).sum((1, 2)) for p in (a * a, a * b, b * b, a * stamps.signal, b * stamps.signal)
    )
    return np.stack([bb * sa - ab * sb, aa * sb - ab * sa]) / np.maximum(aa * bb - ab * ab, 1e-12)


def _rows(fit, index):
    return Fit(**{f.name: getattr(fit, f.name)[index] for f in fields(Fit)})


def _with_rows(old, index, new):
    """A copy of a dataclass of arrays with the rows `index` taken from another."""
    changed = {}
    for f in fields(old):
        changed[f.name] = getattr(old, f.name).copy()
        changed[f.name][index] = getattr(new, f.name)
    return replace(old, **changed)


def _joined(kind, first, second):
    pairs = {f.name: [getattr(first, f.name), getattr(second, f.name)] for f in fields(kind)}
    return kind(**{name: np.concatenate(pair) for name, pair in pairs.items()})

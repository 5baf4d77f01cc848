# SPDX-License-Identifier: Apache-2.0
"""The frame's effective point spread function: what a pixel sees of a star of unit flux at an offset from it.

As Anderson & King (2000, PASP 112, 1360) it is a smooth function of the offset that holds optics, seeing, the
trail and the pixel's own square, learnt from the frame's stars; here as Gauss-Hermite series (Refregier 2003,
MNRAS 338, 35) along the principal axes of the mean star: u along, v across the trail, in units of its widths.
Only even terms are kept, so the centre is the centre of symmetry whatever the fit makes of the rest.

One PSF serves the whole field. Coma whose tail reaches 1 px at the corners, of stars of FWHM 2.4 px, costs 1 to 3 % of
the Cramer-Rao bound; a star of 3000 and one of 60000 electrons then differ there by 0.02 px (what both shift belongs
to the camera's distortion). That is too little for a PSF that varies; but what it fails to describe passes for noise,
and the errors then say twice too much.
"""

from dataclasses import dataclass

import numpy as np

MAX_ORDER = 6


@dataclass(frozen=True, eq=False)
class Psf:
    """axes (2, 2): rows turn an offset (dx, dy) px into (u, v); series (I, J): coefficient of h_i(u) h_j(v),
    Hermite polynomials."""

    axes: np.ndarray
    series: np.ndarray

    @property
    def shape(self):
        """Covariance (2, 2) px2 of the Gaussian the series corrects."""
        inverse = np.linalg.inv(self.axes)
        return inverse @ inverse.T

    @property
    def fwhm_px(self) -> float:
        """Geometric mean over the two axes of that Gaussian's full width at half maximum."""
        return float(np.sqrt(8 * np.log(2)) * abs(np.linalg.det(self.axes)) ** -0.5)

    def within(self, dx, dy, widths):
        """Whether pixels dx, dy px off a star's centre lie within so many widths of it."""
        u, v = (a[0] * dx + a[1] * dy for a in self.axes.astype(np.float32))
        return u * u + v * v < widths**2

    def evaluate(self, dx, dy):
        """value, d/dx0 and d/dy0 (N, S, S): the PSF at pixels dx, dy off a star's centre, and how moving it acts."""
        u, v = (a[0] * dx + a[1] * dy for a in self.axes.astype(np.float32))
        fu, fv = (_hermites(w, n) for w, n in zip((u, v), self.series.shape, strict=True))
        norm = np.float32(abs(np.linalg.det(self.axes)) / (2 * np.pi))
        gauss = np.exp(-0.5 * (u * u + v * v)) * norm
        # -d/du of h_i exp(-u^2 / 2) is sqrt(i + 1) h_i+1 exp(-u^2 / 2)
        series = self.series.astype(np.float32)
        by_u, by_v = (np.sqrt(np.arange(1, n + 1, dtype=np.float32)) for n in series.shape)
        flat = fv.reshape(len(fv), -1)
        # einsum: a product by BLAS wakes its threads, which spin on for longer than it takes
        across = np.einsum("ij,jk->ik", series, flat[:-2]).reshape(-1, *u.shape)
        value = np.einsum("i...,i...->...", fu[:-2], across)
        du = np.einsum("i,i...,i...->...", by_u, fu[1:-1], across)
        across = np.einsum("ij,jk->ik", series * by_v, flat[1:-1]).reshape(-1, *u.shape)
        dv = np.einsum("i...,i...->...", fu[:-2], across)
        (ax, ay), (bx, by) = self.axes.astype(np.float32)
        du, dv = du * gauss, dv * gauss
        return value * gauss, ax * du + bx * dv, ay * du + by * dv


def gaussian(shape) -> Psf:
    """The Psf of an elliptical Gaussian of covariance shape (2, 2) px2; its first axis is the long one."""
    values, vectors = np.linalg.eigh(shape)
    axes = (vectors / np.sqrt(values)).T[::-1]
    return Psf(axes, np.ones((1, 1)))


def refine(psf, dx, dy, brightness, weight, order) -> Psf:
    """The Psf whose even series fits stars best, by weighted linear least squares.

    dx, dy      (M,) px: offsets of M pixels from their stars' centres
    brightness  (M,) values of those pixels over their stars' fluxes
    weight      (M,) inverse variances of brightness
    order       of the terms across the trail; along it more, up to twice as many, as the star is longer
    """
    u, v = psf.axes.astype(np.float32) @ np.stack([dx, dy])
    gauss = np.exp(-0.5 * (u * u + v * v)) * np.float32(abs(np.linalg.det(psf.axes)) / (2 * np.pi))
    long, short = 1 / np.linalg.norm(psf.axes, axis=1)
    stretch = float(np.clip(long / short, 1, 2))
    along = int(order * stretch) // 2 * 2
    fu, fv = _hermites(u, along), _hermites(v, order)
    terms = [
        (i, j)
        for i in range(along + 1)
        for j in range(order + 1)
        if (i + j) % 2 == 0 and i / stretch + j <= order
    ]
    design = np.stack([fu[i] * fv[j] * gauss for i, j in terms])
    weighted = design * weight.astype(np.float32)
    normal = np.einsum("ik,jk->ij", weighted, design).astype(np.float64)
    # a weak pull of the corrections to zero keeps thin data sound
    pull = np.array([0.0] + [1.0] * (len(terms) - 1)) * np.trace(normal) / len(terms) * 1e-4
    found = np.linalg.solve(normal + np.diag(pull), np.einsum("ik,k->i", weighted, brightness))
    series = np.zeros((along + 1, order + 1))
    series[tuple(np.transpose(terms))] = found
    if not np.all(np.isfinite(series)) or series[0, 0] <= 0:
        return psf
    return Psf(psf.axes, series / series[0, 0])  # unit flux: the other terms integrate to zero


def _hermites(u, order):
    """h_0(u) .. h_order+1(u): the probabilists' Hermite polynomials over sqrt(n!), which keeps them of order 1."""
    values = np.empty((order + 2, *u.shape), u.dtype)
    values[0], values[1] = 1, u
    for n in range(1, order + 1):
        values[n + 1] = (u * values[n] - np.float32(n**0.5) * values[n - 1]) * np.float32((n + 1) ** -0.5)
    return values

# SPDX-License-Identifier: Apache-2.0
"""The frame's effective point spread function: what a pixel sees of a star of unit flux at an offset from it.

As Anderson & King (2000, PASP 112, 1360) it is a smooth function of the offset that holds optics, seeing, the
trail and the pixel's own square, learnt from the frame's stars; here as Gauss-Hermite series (Refregier 2003,
MNRAS 338, 35) along the principal axes of the mean star: u along, v across the trail, in units of its widths.
Only even terms are kept, so the centre is the centre of symmetry whatever the fit makes of the rest.
"""

from dataclasses import dataclass
from math import factorial

import numpy as np

MAX_ORDER = 8


@dataclass(frozen=True, eq=False)
class Psf:
    """axes (2, 2): rows turn an offset (dx, dy) px into (u, v); series (K, K): coefficient of He_i(u) He_j(v)."""

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
        order = len(self.series) - 1
        fu, fv = _hermites(u, order + 1), _hermites(v, order + 1)
        norm = np.float32(abs(np.linalg.det(self.axes)) / (2 * np.pi))
        gauss = np.exp(-0.5 * (u * u + v * v)) * norm
        value, du, dv = (np.zeros_like(u) for _ in range(3))
        for i in range(order + 1):
            along = along_dv = None
            for j in range(order + 1 - i):
                c = np.float32(self.series[i, j])
                if c == 0:
                    continue
                along = c * fv[j] if along is None else along + c * fv[j]
                along_dv = c * fv[j + 1] if along_dv is None else along_dv + c * fv[j + 1]
            if along is not None:
                value += fu[i] * along
                du += fu[i + 1] * along  # -d/du He_i exp(-u^2/2) = He_i+1 exp(-u^2/2)
                dv += fu[i] * along_dv
        (ax, ay), (bx, by) = self.axes.astype(np.float32)
        du, dv = du * gauss, dv * gauss
        return value * gauss, ax * du + bx * dv, ay * du + by * dv


def gaussian(shape) -> Psf:
    """The Psf of an elliptical Gaussian of covariance shape (2, 2) px2; its first axis is the long one."""
    values, vectors = np.linalg.eigh(shape)
    axes = (vectors / np.sqrt(values)).T[::-1]
    return Psf(axes, np.ones((1, 1)))


def refine(psf, dx, dy, brightness, weight, order) -> Psf:
    """The Psf whose even series up to `order` fits stars best, by weighted linear least squares.

    dx, dy      (M,) px: offsets of M pixels from their stars' centres
    brightness  (M,) values of those pixels over their stars' fluxes
    weight      (M,) inverse variances of brightness
    """
    u, v = psf.axes.astype(np.float32) @ np.stack([dx, dy])
    gauss = np.exp(-0.5 * (u * u + v * v)) * np.float32(abs(np.linalg.det(psf.axes)) / (2 * np.pi))
    fu, fv = _hermites(u, order), _hermites(v, order)
    terms = [(i, j) for i in range(order + 1) for j in range(order + 1 - i) if (i + j) % 2 == 0]
    size = np.sqrt([float(factorial(i) * factorial(j)) for i, j in terms])
    design = np.stack([fu[i] * fv[j] * gauss / np.float32(s) for (i, j), s in zip(terms, size, strict=True)])
    weighted = design * weight.astype(np.float32)
    normal = (weighted @ design.T).astype(np.float64)
    # a weak pull of the corrections to zero keeps thin data sound
    pull = np.array([0.0] + [1.0] * (len(terms) - 1)) * np.trace(normal) / len(terms) * 1e-4
    found = np.linalg.solve(normal + np.diag(pull), weighted @ brightness) / size
    series = np.zeros((order + 1, order + 1))
    for (i, j), c in zip(terms, found, strict=True):
        series[i, j] = c
    if not np.all(np.isfinite(series)) or series[0, 0] <= 0:
        return psf
    return Psf(psf.axes, series / series[0, 0])  # unit flux: the other terms integrate to zero


def _hermites(u, order):
    """He_0(u) .. He_order(u), the probabilists' Hermite polynomials."""
    values = [np.ones_like(u), u]
    for n in range(1, order):
        values.append(u * values[n] - n * values[n - 1])
    return values[: order + 1]

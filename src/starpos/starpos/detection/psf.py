# SPDX-License-Identifier: Apache-2.0
"""The frame's effective point spread function: what a pixel sees of a star of unit flux at an offset from it.

As Anderson & King (2000, PASP 112, 1360) it is a smooth function of the offset that holds optics, seeing, the
trail and the pixel's own square, learnt from the frame's stars and, where that describes them better, different from
place to place; here as Gauss-Hermite series (Refregier 2003, MNRAS 338, 35) along the principal axes of the mean star:
u along, v across the trail, in units of its widths. The centre is the centroid of all light, since the series has no
term of first order.
"""

from dataclasses import dataclass, replace

import numpy as np

MONOMIALS = 6  # of second order in the field's coordinates
NARROW, BROAD = 0.25, 6.0  # limits of a place's squared widths over the mean ones


@dataclass(frozen=True, eq=False)
class LocalPsf:
    """The PSF where N stars are; N = 1 serves any number of them.

    axes    (N, 2, 2): rows turn an offset (dx, dy) px into (u, v)
    series  (N, I, J): coefficient of h_i(u) h_j(v), Hermite polynomials
    """

    axes: np.ndarray
    series: np.ndarray

    @property
    def shape(self):
        """(N, 2, 2) px2: covariances of the Gaussians the series correct."""
        inverse = np.linalg.inv(self.axes)
        return inverse @ inverse.transpose(0, 2, 1)

    def within(self, dx, dy, widths):
        """Whether pixels dx, dy px off the stars' centres lie within so many widths of them."""
        u, v = self._scaled(dx, dy)
        return u * u + v * v < widths**2

    def evaluate(self, dx, dy):
        """value, d/dx0 and d/dy0 (N, S, S): the PSF at pixels dx, dy off the stars' centres, and how moving them acts."""
        u, v = self._scaled(dx, dy)
        place, u, v = u.shape, u.reshape(len(u), -1), v.reshape(len(v), -1)
        _, i, j = self.series.shape
        fu, fv = _hermites(u, i), _hermites(v, j)
        gauss = self._gauss(u, v)
        # -d/du of h_i exp(-u^2 / 2) is sqrt(i + 1) h_i+1 exp(-u^2 / 2)
        series = self.series.astype(np.float32)
        by_u, by_v = (np.sqrt(np.arange(1, n + 1, dtype=np.float32)) for n in (i, j))
        across = series @ fv[:, :-1]
        value = np.einsum("nip,nip->np", fu[:, :-1], across) * gauss
        across *= by_u[:, None]
        du = np.einsum("nip,nip->np", fu[:, 1:], across) * gauss
        across = (series * by_v) @ fv[:, 1:]
        dv = np.einsum("nip,nip->np", fu[:, :-1], across) * gauss
        a = self.axes.astype(np.float32)[..., None]
        by_x, by_y = (a[:, 0, k] * du + a[:, 1, k] * dv for k in (0, 1))
        return value.reshape(place), by_x.reshape(place), by_y.reshape(place)

    def terms(self, dx, dy, orders):
        """(N, T, P): each term i, j of `orders` (T, 2) alone at P = S S pixels."""
        u, v = (w.reshape(len(w), -1) for w in self._scaled(dx, dy))
        i, j = np.transpose(orders)
        terms = _hermites(u, max(1, i.max()))[:, i]
        terms *= _hermites(v, max(1, j.max()))[:, j]
        terms *= self._gauss(u, v)[:, None]
        return terms

    def _scaled(self, dx, dy):
        a = self.axes.astype(np.float32)[..., None, None]
        return a[:, 0, 0] * dx + a[:, 0, 1] * dy, a[:, 1, 0] * dx + a[:, 1, 1] * dy

    def _gauss(self, u, v):
        norm = np.abs(np.linalg.det(self.axes)).astype(np.float32)[:, None] / np.float32(2 * np.pi)
        return np.exp(-0.5 * (u * u + v * v)) * norm


@dataclass(frozen=True, eq=False)
class Psf:
    """The PSF of a frame of size (width, height) px: `at` gives it where stars are.

    axes    (2, 2): those of the mean star, as a LocalPsf has them
    widths  (K, 2, 2): squared widths along these axes, as coefficients of the field's K monomials; K is 6, or 1: the
            same everywhere
    series  (K, I, J): the coefficients of the series, likewise
    box     (2, 2): the lowest x, y and the highest, px, of the stars it was learnt from; beyond, it is as at its edge
    """

    axes: np.ndarray
    widths: np.ndarray
    series: np.ndarray
    box: np.ndarray

    @property
    def shape(self):
        """Covariance (2, 2) px2 of the mean star."""
        inverse = np.linalg.inv(self.axes)
        return inverse @ inverse.T

    @property
    def fwhm_px(self) -> float:
        """Geometric mean over the two axes of the mean star's full width at half maximum."""
        return float(np.sqrt(8 * np.log(2)) * abs(np.linalg.det(self.axes)) ** -0.5)

    def at(self, x, y) -> LocalPsf:
        """The PSF at the points x, y (N,) px."""
        axes, series = self.axes[None], self.series[:1]
        if len(self.widths) > 1:
            axes = power(np.tensordot(self.monomials(x, y), self.widths, 1), -0.5) @ self.axes
        if len(self.series) > 1:
            series = np.tensordot(self.monomials(x, y), self.series, 1)
        return LocalPsf(axes, series)

    def monomials(self, x, y):
        """(N, 6): of the field's coordinates, each from -1 to 1, and of zero mean over the box but for the first."""
        low, high = self.box
        place = 2 * (np.stack([x, y], -1) - low) / np.maximum(high - low, 1) - 1
        p, q = np.nan_to_num(np.clip(place, -1, 1)).T  # a star whose fit failed is nowhere
        return np.stack([np.ones_like(p), p, q, p * p - 1 / 3, p * q, q * q - 1 / 3], -1)

    def with_widths(self, widths) -> "Psf":
        """With other squared widths (6, 2, 2) along these axes, made those of the mean star's axes."""
        root = power(widths[:1], -0.5)[0]
        return replace(self, axes=root @ self.axes, widths=root @ widths @ root)


def gaussian(shape, x=(0.0,), y=(0.0,)) -> Psf:
    """The Psf of an elliptical Gaussian of covariance shape (2, 2) px2, learnt from stars at x, y (N,) px.

    Its first axis is the long one.
    """
    values, vectors = np.linalg.eigh(shape)
    axes = (vectors / np.sqrt(values)).T[::-1]
    box = np.array([[np.min(x), np.min(y)], [np.max(x), np.max(y)]])
    return Psf(axes, np.eye(2)[None], np.ones((1, 1, 1)), box)


def power(widths, exponent):
    """Symmetric powers of squared widths (N, 2, 2), these kept within what a field can do."""
    values, vectors = np.linalg.eigh(widths)
    values = np.clip(values, NARROW, BROAD) ** exponent
    return (vectors * values[:, None]) @ vectors.transpose(0, 2, 1)


def _hermites(u, order):
    """(N, order + 1, P): h_0(u) .. h_order(u) of u (N, P), the probabilists' Hermite polynomials over sqrt(n!), which
    keeps them of order 1; order >= 1."""
    values = np.empty((len(u), order + 1, u.shape[1]), u.dtype)
    values[:, 0], values[:, 1] = 1, u
    for n in range(1, order):
        values[:, n + 1] = (u * values[:, n] - np.float32(n**0.5) * values[:, n - 1]) * np.float32(
            (n + 1) ** -0.5
        )
    return values

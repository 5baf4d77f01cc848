# SPDX-License-Identifier: Apache-2.0
"""The frame's effective point spread function: the value of a pixel at an offset from a star of unit flux.

It is a smooth function of the offset (Anderson & King 2000, PASP 112, 1360) that includes optics, seeing, the star's
trail and the pixel's square. It is learnt from the frame's stars and may vary over the field. It is a Gauss-Hermite
series (Refregier 2003, MNRAS 338, 35) along the principal axes of the mean star: u along the trail, v across it, in
units of the star's widths. The series has no term of first order, so its centre is the centroid of all light.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.polynomial import hermite_e
from numpy.typing import ArrayLike

from starpos.core.field import local, monomials, shapes_of
from starpos.core.psf import evaluated
from starpos.core.shapes import clipped

# How many monomials describe a variation over the field: up to second order in x and y.
MONOMIALS = 6
# Limits of the squared widths at a place of the field over the mean ones.
NARROW, BROAD = 0.25, 6.0
# The series of a Gaussian.
GAUSSIAN = np.ones((1, 1, 1))
# of the series that a trail has along it
TRAIL_ORDER = 24


@dataclass(frozen=True, eq=False)
class LocalPsf:
    """The PSF at the places of N stars; N = 1 serves any number of stars.

    axes    (N, 2, 2): matrices that turn an offset (dx, dy) px into (u, v)
    series  (N, I, J): coefficients of h_i(u) h_j(v), Hermite polynomials
    """

    axes: np.ndarray
    series: np.ndarray

    @property
    def shape(self) -> np.ndarray:
        """Covariances (N, 2, 2) px2 of the Gaussians that the series multiply."""
        return shapes_of(self.axes)

    def evaluate(self, left: np.ndarray, top: np.ndarray, size: int) -> np.ndarray:
        """The PSF at the pixels of N stamps (N, size, size).

        left, top (N,) px: of each stamp's first column and row from its star's centre.
        """
        return evaluated(self.axes, self.series, left, top, size)


@dataclass(frozen=True, eq=False)
class Psf:
    """The PSF of a frame; `at` gives it at the places of stars.

    axes    (2, 2): those of the mean star, as in LocalPsf
    widths  (K, 2, 2): squared widths along these axes, as coefficients of K monomials of the field's coordinates; K is
            6, or 1 if they are the same everywhere
    series  (K, I, J): coefficients of the series, in the same way
    box     (2, 2): lowest and highest x, y, px, of the stars it was learnt from; beyond, the PSF is that of its edge
    """

    axes: np.ndarray
    widths: np.ndarray
    series: np.ndarray
    box: np.ndarray

    @property
    def shape(self) -> np.ndarray:
        """Covariance (2, 2) px2 of the mean star."""
        inverse = np.linalg.inv(self.axes)
        return inverse @ inverse.T

    @property
    def fwhm_px(self) -> float:
        """Geometric mean over the two axes of the mean star's full width at half maximum."""
        (a, b), (c, d) = self.axes.tolist()
        return math.sqrt(8 * math.log(2)) * abs(a * d - b * c) ** -0.5

    def at(self, x: np.ndarray, y: np.ndarray) -> LocalPsf:
        """The PSF at the points x, y (N,) px."""
        return LocalPsf(*local(*_points(x, y), self.box, self.axes, self.widths, self.series, NARROW, BROAD))

    def shapes_at(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Covariances (N, 2, 2) px2, or (1, 2, 2), of the Gaussians of the PSF at the points x, y (N,) px."""
        return shapes_of(local(*_points(x, y), self.box, self.axes, self.widths, GAUSSIAN, NARROW, BROAD)[0])

    def monomials(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Monomials (N, 6) of x, y scaled to -1..1 over the box; all but the first have zero mean over it."""
        return monomials(*_points(x, y), self.box)

    def with_widths(self, widths: np.ndarray) -> "Psf":
        """The Psf with the squared widths (6, 2, 2) along these axes; its axes become those of the new mean star."""
        root = power(widths[:1], -0.5)[0]
        return replace(self, axes=root @ self.axes, widths=root @ widths @ root)


def _points(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return np.ascontiguousarray(x, float), np.ascontiguousarray(y, float)


def gaussian(shape: np.ndarray, x: ArrayLike = (0.0,), y: ArrayLike = (0.0,)) -> Psf:
    """The Psf of an elliptical Gaussian of covariance shape (2, 2) px2; its box holds the points x, y (N,) px.

    The first axis is the long one.
    """
    values, vectors = np.linalg.eigh(shape)
    axes = np.ascontiguousarray((vectors / np.sqrt(values)).T[::-1])
    box = np.array([[np.min(x), np.min(y)], [np.max(x), np.max(y)]], float)
    return Psf(axes, np.eye(2)[None], np.ones((1, 1, 1)), box)


def trailed(sigma: float, trail: np.ndarray) -> Psf:
    """The Psf of a round Gaussian of sigma px that moves evenly along a trail (2,) px.

    The coefficient of h_i is its mean over the light: that of He_i / sqrt(i!) over +-sqrt(3), where an even spread has a
    variance of 1, times the power i / 2 of the trail's share of the variance along it.
    """
    psf = gaussian(np.eye(2) * sigma**2 + np.outer(trail, trail) / 12)
    share = 1 - sigma**2 * (psf.axes[0] @ psf.axes[0])
    even = np.arange(0, TRAIL_ORDER + 1, 2)
    root = np.array([math.sqrt(3 * math.factorial(i)) for i in even])
    highest = hermite_e.hermeval(np.sqrt(3), np.eye(TRAIL_ORDER + 2)[:, even + 1])
    series = np.zeros((1, TRAIL_ORDER + 1, 1))
    series[0, even, 0] = share ** (even / 2) * highest / ((even + 1) * root)
    return replace(psf, series=series)


def power(widths: np.ndarray, exponent: float) -> np.ndarray:
    """Powers of the symmetric matrices of squared widths (N, 2, 2), with eigenvalues limited to NARROW..BROAD."""
    return clipped(widths, NARROW, BROAD, exponent)

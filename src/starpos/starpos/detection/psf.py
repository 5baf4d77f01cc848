# SPDX-License-Identifier: Apache-2.0
"""The frame's effective point spread function, learnt from its stars."""

import math
from dataclasses import dataclass, replace

import numpy as np

from starpos.detection._moments import clip_widths, squared_widths
from starpos.detection._psf import evaluated, monomials, psf_at, shapes_of

# How many monomials describe a variation over the field: up to second order in x and y.
MONOMIALS = 6
# Limits of the squared widths at a place of the field over the mean ones.
NARROW, BROAD = 0.25, 6.0
# Where in the box (0 to 1 in x, in y) the widest star is looked for.
QUARTERS = np.tile(np.arange(5) / 4, 5), np.repeat(np.arange(5) / 4, 5)
# Squared widths and series of a Gaussian that is the same everywhere; a place, if only one is asked for.
UNIFORM, GAUSSIAN, ONE_PLACE = np.eye(2)[None], np.ones((1, 1, 1)), np.zeros(1)


@dataclass(frozen=True, eq=False)
class LocalPsf:
    """The PSF at the places of N stars; N = 1 serves any number of stars.

    axes    (N, 2, 2): matrices that turn an offset (dx, dy) px into (u, v)
    series  (N, I, J): coefficients of h_i(u) h_j(v), Hermite polynomials
    """

    axes: np.ndarray
    series: np.ndarray

    def evaluate(self, left: np.ndarray, top: np.ndarray, size: int) -> np.ndarray:
        """The PSF at the pixels of N stamps (N, size, size).

        left, top (N,) px: first column and row of a stamp, from the centre of the star.
        """
        return evaluated(self.axes, self.series, left, top, size)


@dataclass(frozen=True, eq=False)
class Psf:
    """The PSF of a frame; `at` gives it at the places of stars.

    axes    (2, 2): the mean star's, as in LocalPsf
    widths  (K, 2, 2): squared widths along these axes, as coefficients of K monomials of the field's coordinates; K is
            6, or 1 if they are the same everywhere
    series  (K, I, J): coefficients of the series, in the same way
    box     (2, 2): lowest and highest x, y, px, of the stars it was learnt from; beyond, the PSF is as at its edge
    """

    axes: np.ndarray
    widths: np.ndarray
    series: np.ndarray
    box: np.ndarray

    @property
    def fwhm_px(self) -> float:
        """Geometric mean over the two axes of the mean star's full width at half maximum."""
        (a, b), (c, d) = self.axes.tolist()
        return math.sqrt(8 * math.log(2)) * abs(a * d - b * c) ** -0.5

    def at(self, x: np.ndarray, y: np.ndarray) -> LocalPsf:
        """The PSF at the points x, y (N,) px."""
        return LocalPsf(*psf_at(*_points(x, y), self.box, self.axes, self.widths, self.series, NARROW, BROAD))

    def shapes_at(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Covariances (N, 2, 2) px2, or (1, 2, 2), of the Gaussians of the PSF at the points x, y (N,) px."""
        return shapes_of(psf_at(*_points(x, y), self.box, self.axes, self.widths, GAUSSIAN, NARROW, BROAD)[0])

    def widest_px2(self) -> float:
        """The largest squared width of a star within the box."""
        (left, top), (right, bottom) = self.box
        # one place is enough if the widths are the same everywhere
        across, down = QUARTERS if len(self.widths) > 1 else (QUARTERS[0][:1], QUARTERS[1][:1])
        shapes = self.shapes_at(left + (right - left) * across, top + (bottom - top) * down)
        return float(squared_widths(shapes)[:, 1].max())

    def monomials(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Monomials (N, 6) of x, y scaled to -1..1 over the box; all but the first have zero mean over it."""
        return monomials(*_points(x, y), self.box)

    def with_widths(self, widths: np.ndarray) -> "Psf":
        """The Psf with the squared widths (6, 2, 2) along these axes; its axes become the new mean star's."""
        root = power(widths[:1], -0.5)[0]
        return replace(self, axes=root @ self.axes, widths=root @ widths @ root)


def _points(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return np.ascontiguousarray(x, float), np.ascontiguousarray(y, float)


def gaussian(shape: np.ndarray, x: np.ndarray = ONE_PLACE, y: np.ndarray = ONE_PLACE) -> Psf:
    """The Psf of an elliptical Gaussian of covariance shape (2, 2) px2; its box holds the points x, y (N,) px.

    The first axis is the long one.
    """
    (xx, xy), (_, yy) = shape.tolist()
    mean, half = (xx + yy) / 2, math.hypot((xx - yy) / 2, xy)
    angle = math.atan2(2 * xy, xx - yy) / 2
    along, across = (mean + half) ** -0.5, (mean - half) ** -0.5
    cos, sin = math.cos(angle), math.sin(angle)
    axes = np.array([[cos * along, sin * along], [-sin * across, cos * across]])
    box = np.array([[x.min(), y.min()], [x.max(), y.max()]], float)
    return Psf(axes, UNIFORM, GAUSSIAN, box)


def power(widths: np.ndarray, exponent: float) -> np.ndarray:
    """Powers of the symmetric matrices of squared widths (N, 2, 2), with eigenvalues limited to NARROW..BROAD."""
    return clip_widths(widths, NARROW, BROAD, exponent)

# SPDX-License-Identifier: Apache-2.0
"""The PSF of stars that move as somebody knows: a round Gaussian, drawn along the trail of each place."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.polynomial import hermite_e

from starpos.detection.psf import FieldPsf, LocalPsf, gaussian
from starpos.frames.trail import Trail

# of the series along the trail
ORDER = 24


@dataclass(frozen=True, eq=False)
class TrailedPsf(FieldPsf):
    """A round Gaussian of sigma px that moves evenly along its trail, on a frame of width by height px."""

    axes: np.ndarray
    sigma: float
    trail: Trail
    width: int
    height: int

    def at(self, x: np.ndarray, y: np.ndarray) -> LocalPsf:
        """The PSF at the points x, y (N,) px.

        The coefficient of h_i is its mean over the light: the mean of He_i / sqrt(i!) over +-sqrt(3), where an even
        spread has a variance of 1, times the power i / 2 of the trail's share of the variance along it.
        """
        way = self.trail.at(x, y, self.width, self.height)
        length = np.hypot(way[:, 0], way[:, 1])
        along = np.where(length[:, None] > 0, way / np.maximum(length, 1e-9)[:, None], [1.0, 0.0])
        drawn = length**2 / 12
        axes = np.stack([along, np.stack([-along[:, 1], along[:, 0]], -1)], 1) / self.sigma
        axes[:, 0] *= (self.sigma / np.sqrt(self.sigma**2 + drawn))[:, None]
        series = np.zeros((len(x), ORDER + 1, 1))
        series[:, EVEN, 0] = (drawn / (self.sigma**2 + drawn))[:, None] ** (EVEN / 2) * FLAT
        return LocalPsf(axes, series)

    def widest_px2(self) -> float:
        """The largest squared width of a star on the frame, which is in a corner."""
        x, y = (
            np.array([0.0, 1.0, 0.0, 1.0]) * (self.width - 1),
            np.array([0.0, 0.0, 1.0, 1.0]) * (self.height - 1),
        )
        return float(np.linalg.eigvalsh(self.shapes_at(x, y)).max())

    def shapes_at(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Covariances (N, 2, 2) px2 of the Gaussians of the PSF at the points x, y (N,) px."""
        way = self.trail.at(x, y, self.width, self.height)
        return self.sigma**2 * np.eye(2) + way[:, :, None] * way[:, None, :] / 12


def trailed(sigma: float, trail: Trail, width: int, height: int) -> TrailedPsf:
    """The PSF of a round Gaussian of sigma px that moves along a trail."""
    mean = gaussian(sigma**2 * np.eye(2) + trail.mean_square(width, height) / 12)
    return TrailedPsf(mean.axes, sigma, trail, width, height)


def _flat() -> np.ndarray:
    """Coefficients of an even spread of variance 1, of the even orders."""
    root = np.array([math.sqrt(3 * math.factorial(i)) for i in EVEN])
    highest = hermite_e.hermeval(np.sqrt(3), np.eye(ORDER + 2)[:, EVEN + 1])
    return np.asarray(highest / ((EVEN + 1) * root))


EVEN = np.arange(0, ORDER + 1, 2)
FLAT = _flat()

# SPDX-License-Identifier: Apache-2.0
"""Residuals compared with their stated errors: which are outliers, and how much more the others scatter."""

import numpy as np

from starpos.core.observed import extra_variance
from starpos.normal import MEDIAN_OF_CHI2

OUTLIER_SIGMA = 5.0
# the grid of variances that `expected_extra` integrates over: points, least in units of the stated variance, most in
# units of the sum of the squared residuals
GRID, GRID_LEAST, GRID_MOST = 128, 1e-3, 1e2
# the search of `_extra_variance`: least as a share of the most, points of a grid, grids; good to 1e-3
LEAST_EXTRA, COARSE, ROUNDS = 1e-12, 24, 4


def judged(
    residual: np.ndarray, covariance: np.ndarray, keep: np.ndarray, share: float
) -> tuple[float, np.ndarray]:
    """Scatter of residuals (N, 2) px beyond their covariance (N, 2, 2) px2, and a mask (N,) of those that are right.

    The scatter is an isotropic variance in px2, of the residuals in the mask `keep` (N,).  share: that part of the 2 N
    coordinates which the parameters of the fit leave free.
    """
    # the gate goes by the median: by the mean an outlier among a dozen stars would widen it enough to pass
    kept = residual[keep], covariance[keep]
    typical = _extra_variance(*kept, share, MEDIAN_OF_CHI2)
    extra = _extra_variance(*kept, share)
    return extra, distance2(residual, covariance, typical) < OUTLIER_SIGMA**2


def expected_extra(residual: np.ndarray, covariance: np.ndarray, share: float) -> float:
    """Extra isotropic variance (px2) to use in a covariance: its expectation instead of the likeliest value.

    Few stars hardly tell how much they scatter, and the likeliest value is mostly too small: the errors of a fit of N
    stars follow Student's t.  This is the mean of the posterior under Jeffreys' prior of the whole variance; for errors
    that are all alike it is the mean of the inverse gamma distribution.  For many stars it is the value of `judged`.
    """
    stated = np.median(np.trace(covariance, axis1=1, axis2=2)) / 2
    most = max(stated, float(np.sum(residual**2)))
    extra = np.geomspace(GRID_LEAST * stated, GRID_MOST * most, GRID)
    d2 = distance2(residual, covariance, extra[:, None])
    log_determinant = np.log(_widened(covariance, extra[:, None])[3])
    log_density = -0.5 * (d2 + share * log_determinant).sum(1) - np.log(stated + extra) + np.log(extra)
    density = np.exp(log_density - log_density.max())
    return float(density @ extra / density.sum())


def distance2(residual: np.ndarray, covariance: np.ndarray, extra: float | np.ndarray = 0.0) -> np.ndarray:
    """Squared residuals (N,) in units of their covariance plus an extra isotropic variance (px2).

    For `extra` (G, 1): (G, N).
    """
    (x, y), (xx, xy, yy, determinant) = residual.T, _widened(covariance, extra)
    return (yy * x * x - 2 * xy * x * y + xx * y * y) / determinant


def _widened(covariance: np.ndarray, extra: float | np.ndarray) -> tuple[np.ndarray, ...]:
    """The elements xx, xy, yy and the determinant of covariances (N, 2, 2) plus an extra isotropic variance."""
    xx, xy, yy = covariance[:, 0, 0] + extra, covariance[:, 0, 1], covariance[:, 1, 1] + extra
    return xx, xy, yy, xx * yy - xy * xy


def _extra_variance(
    residual: np.ndarray, covariance: np.ndarray, share: float, median_of_chi2: float = 0.0
) -> float:
    """The isotropic variance (px2) at which residuals are as large as their covariance says, 0 if they never are larger.

    By the mean of their squares, or by the median where that of chi squared is given. The search uses grids, each between
    two points of the last one: to import scipy.optimize takes longer than a node takes to start.
    """
    high = 8 * float(np.vdot(residual, residual)) + 1e-12
    return extra_variance(
        residual, covariance, share, median_of_chi2, high, LEAST_EXTRA * high, COARSE, ROUNDS
    )

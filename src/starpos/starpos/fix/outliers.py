# SPDX-License-Identifier: Apache-2.0
"""Residuals against their stated errors: which are outliers, and how much more the others scatter."""

from collections.abc import Callable

import numpy as np

OUTLIER_SIGMA = 5.0
GRID, GRID_LEAST, GRID_MOST = 128, 1e-3, 1e2  # of variances, in units of the stated and of all residuals
# of the search for one: parts of the largest, points of a grid, grids; to 1e-3
LEAST_EXTRA, COARSE, ROUNDS = 1e-12, 24, 4
MEDIAN_OF_CHI2 = 2 * np.log(2)  # of two degrees of freedom


def judged(
    residual: np.ndarray, covariance: np.ndarray, keep: np.ndarray, share: float
) -> tuple[float, np.ndarray]:
    """The isotropic variance (px2) by which residuals (N, 2) px to keep (N,) scatter beyond covariance (N, 2, 2),
    and which of all of them are to be kept.

    share: of the 2 N coordinates, those that the parameters of the fit leave free.
    """
    # by the median, else an outlier among a dozen stars would widen the gate enough to pass itself
    typical = _extra_variance(
        residual[keep], covariance[keep], lambda d2: np.median(d2, axis=-1) / MEDIAN_OF_CHI2 - share
    )
    extra = _extra_variance(residual[keep], covariance[keep], lambda d2: d2.mean(-1) / 2 - share)
    return extra, distance2(residual, covariance, typical) < OUTLIER_SIGMA**2


def expected_extra(residual: np.ndarray, covariance: np.ndarray, share: float) -> float:
    """The same variance (px2) as a fit's errors have to be claimed with: its mean over all that it may be.

    Few stars hardly tell how much they scatter, and the likeliest value is mostly too small: the errors of a fit of N
    stars go as Student's t.  This is the mean of the posterior under Jeffreys' prior of the whole variance, which for
    errors that are all alike is that of the inverse gamma distribution.  Of many stars it is what `judged` says.
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
    """Squared residuals (N,) in units of their covariance and an extra isotropic variance (px2); (G, N) of (G, 1)."""
    (x, y), (xx, xy, yy, determinant) = residual.T, _widened(covariance, extra)
    return (yy * x * x - 2 * xy * x * y + xx * y * y) / determinant


def _widened(covariance: np.ndarray, extra: float | np.ndarray) -> tuple[np.ndarray, ...]:
    """xx, xy, yy and the determinant of covariances (N, 2, 2) with an extra isotropic variance."""
    xx, xy, yy = covariance[:, 0, 0] + extra, covariance[:, 0, 1], covariance[:, 1, 1] + extra
    return xx, xy, yy, xx * yy - xy * xy


def _extra_variance(residual: np.ndarray, covariance: np.ndarray, excess: Callable) -> float:
    """The isotropic variance (px2) at which excess(squared distances (..., N)) is 0; 0 where it never is above.

    By grids, each between two points of the one before: scipy.optimize takes longer to import than a node to start.
    """
    if excess(distance2(residual, covariance)) <= 0:
        return 0.0
    high = 8 * float(np.sum(residual**2)) + 1e-12
    low = LEAST_EXTRA * high
    for _ in range(ROUNDS):
        extra = np.geomspace(low, high, COARSE)
        below = np.flatnonzero(excess(distance2(residual, covariance, extra[:, None])) < 0)
        if not len(below):
            return high
        low, high = extra[max(below[0] - 1, 0)], extra[below[0]]
    return float(np.sqrt(low * high))

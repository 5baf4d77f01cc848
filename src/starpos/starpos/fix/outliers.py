# SPDX-License-Identifier: Apache-2.0
"""Residuals compared with their stated errors: the outliers, and the extra scatter of the others."""

import numpy as np

from starpos.fix._scatter import distances2, expected_variance, sifted
from starpos.normal import MEDIAN_OF_CHI2

OUTLIER_SIGMA = 5.0
# the grid of variances that `expected_extra` integrates over: minimum in units of the stated variance, maximum in units
# of the sum of the squared residuals
GRID_LEAST, GRID_MOST = 1e-3, 1e2
# the search of the extra variance: minimum as a share of the maximum, and relative precision
MIN_EXTRA, GOOD_EXTRA = 1e-12, 2e-4


def judged(
    residual: np.ndarray, covariance: np.ndarray, keep: np.ndarray, share: float
) -> tuple[float, np.ndarray]:
    """Scatter of residuals (N, 2) px beyond their covariance (N, 2, 2) px2, and a mask (N,) without outliers.

    The scatter is an isotropic variance in px2, of the residuals in the mask `keep` (N,).  share: the part of the 2 N
    coordinates that the parameters of the fit leave free.
    """
    return sifted(
        np.ascontiguousarray(residual, float),
        np.ascontiguousarray(covariance, float),
        np.ascontiguousarray(keep, bool).view(np.uint8),
        share,
        MEDIAN_OF_CHI2,
        OUTLIER_SIGMA**2,
        MIN_EXTRA,
        GOOD_EXTRA,
    )


def expected_extra(residual: np.ndarray, covariance: np.ndarray, share: float) -> float:
    """Extra isotropic variance (px2) to use in a covariance: its expectation instead of the likeliest value.

    Few stars hardly determine their scatter, and the likeliest value is mostly too small: the errors of a fit of N
    stars follow Student's t.  This is the mean of the posterior under Jeffreys' prior of the whole variance; for errors
    that are all alike it is the mean of the inverse gamma distribution.  For many stars it is the value of `judged`.
    """
    residual, covariance = np.ascontiguousarray(residual, float), np.ascontiguousarray(covariance, float)
    # the median; numpy's own takes longer than everything else here
    traces = np.sort(covariance[:, 0, 0] + covariance[:, 1, 1])
    stated = float(traces[(len(traces) - 1) // 2] + traces[len(traces) // 2]) / 4
    most = GRID_MOST * max(stated, float(np.vdot(residual, residual)))
    return expected_variance(residual, covariance, share, stated, GRID_LEAST * stated, most)


def distance2(residual: np.ndarray, covariance: np.ndarray, extra: float = 0.0) -> np.ndarray:
    """Squared residuals (N,) in units of their covariance plus an extra isotropic variance (px2)."""
    return distances2(np.ascontiguousarray(residual, float), np.ascontiguousarray(covariance, float), extra)

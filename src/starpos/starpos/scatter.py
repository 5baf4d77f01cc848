# SPDX-License-Identifier: Apache-2.0
"""Residuals against their stated errors: which are outliers, and how much more the others scatter."""

from collections.abc import Callable

import numpy as np

OUTLIER_SIGMA = 5.0
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
        residual[keep], covariance[keep], lambda d2: np.median(d2) / MEDIAN_OF_CHI2 - share
    )
    extra = _extra_variance(residual[keep], covariance[keep], lambda d2: d2.mean() / 2 - share)
    return extra, distance2(residual, covariance, typical) < OUTLIER_SIGMA**2


def distance2(residual: np.ndarray, covariance: np.ndarray, extra: float = 0.0) -> np.ndarray:
    """Squared residuals (N,) in units of their covariance and an extra isotropic variance (px2)."""
    (x, y), xx, xy, yy = (
        residual.T,
        covariance[:, 0, 0] + extra,
        covariance[:, 0, 1],
        covariance[:, 1, 1] + extra,
    )
    return (yy * x * x - 2 * xy * x * y + xx * y * y) / (xx * yy - xy * xy)


def _extra_variance(residual: np.ndarray, covariance: np.ndarray, excess: Callable) -> float:
    """The isotropic variance (px2) at which excess(squared distances) is 0; 0 where it never is above."""

    def above(extra):
        return excess(distance2(residual, covariance, extra))

    if above(0.0) <= 0:
        return 0.0
    high = 8 * np.sum(residual**2) + 1e-12
    from scipy.optimize import brentq  # slow to import: only where stars are fitted

    return float(brentq(above, 0.0, high, xtol=1e-12, rtol=1e-3)) if above(high) < 0 else float(high)

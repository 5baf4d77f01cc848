# SPDX-License-Identifier: Apache-2.0
# cython: language_level=3, boundscheck=False, wraparound=False, cdivision=True, initializedcheck=False
"""Stars in the directions in which a camera on the ground observes them, and how these turn; scatter of residuals."""

from libc.math cimport cos, exp, hypot, log, sin, sqrt
from libc.stdlib cimport free, malloc

import numpy as np

from starpos.core.algebra cimport median, turned


cdef class Air:
    """Refraction a tan z + b tan^3 z, in rad, at the observed zenith distance z, as `refraction.Refraction` has it.

    least_up: cosine of the zenith distance beyond which it does not grow.
    """

    cdef double a, b, least_up

    def __init__(self, double a, double b, double least_up):
        self.a, self.b, self.least_up = a, b, least_up

    cdef void bend(self, const double *v, double *out) noexcept nogil:
        """Set `out` (3,) to the observed direction of v (3,) in L."""
        cdef double flat = max(hypot(v[0], v[1]), 1e-12), up = max(v[2], self.least_up), tan = flat / up
        cdef double w = self.b * tan * tan, angle = (self.a + w) * tan / (1 + (self.a + 3 * w) / (up * up))
        cdef double c = cos(angle), s = sin(angle), shrink = c - s * v[2] / flat
        out[0], out[1], out[2] = v[0] * shrink, v[1] * shrink, c * v[2] + s * flat

    cdef void bend_slopes(self, const double *v, const double *u, double *slope) noexcept nogil:
        """Set slope (3, 3) to the derivatives of u (3,), what v (3,) is bent to, by small rotations of v about L's axes."""
        cdef double flat = max(hypot(v[0], v[1]), 1e-12), up = max(v[2], self.least_up), tan = flat / up
        cdef double w = self.b * tan * tan, above = (self.a + w) * tan, below = 1 + (self.a + 3 * w) / (up * up)
        # by the zenith distance
        cdef double up_falls = flat if v[2] > self.least_up else 0.0
        cdef double tan_grows = (v[2] * up + flat * up_falls) / (up * up)
        cdef double above_grows = (self.a + 3 * w) * tan_grows
        cdef double below_grows = 6 * self.b * tan * tan_grows / (up * up) + 2 * (below - 1) / up * up_falls
        cdef double nearer = 1 - (above_grows * below - above * below_grows) / (below * below)
        cdef double seen = hypot(u[0], u[1]), shrink = max(seen, 1e-12) / flat
        # at the zenith any azimuth will do
        cdef double x = v[0] / flat if flat > 1e-9 else 1.0, y = v[1] / flat if flat > 1e-9 else 0.0
        cdef double[3] moved
        cdef double away, aside
        cdef int k
        for k in range(3):
            # the axis times v
            moved[0] = v[2] if k == 1 else -v[1] if k == 2 else 0.0
            moved[1] = -v[2] if k == 0 else v[0] if k == 2 else 0.0
            moved[2] = v[1] if k == 0 else -v[0] if k == 1 else 0.0
            away = (x * moved[0] + y * moved[1]) * v[2] - moved[2] * flat
            aside = x * moved[1] - y * moved[0]
            slope[k] = x * u[2] * away * nearer - y * aside * shrink
            slope[3 + k] = y * u[2] * away * nearer + x * aside * shrink
            slope[6 + k] = -seen * away * nearer


def observed(
    const double[:, ::1] itrs, const double[:, ::1] a4, velocity, Air air, const double[:, ::1] g, bint with_slopes=False
):
    """Directions (N, 3) in C in which stars are observed.

    itrs      (N, 3): their geocentric apparent directions
    a4        (3, 3): ITRS into L
    velocity  (3,): of the ground, in units of c
    g         (3, 3): C into L

    Returns with_slopes also their derivatives (N, 3, 3) by small rotations about L's axes. Left out of these is how the
    ground's velocity depends on the place: 1.5e-6 of them.
    """
    cdef Py_ssize_t n = itrs.shape[0], k
    cdef double[3] v
    cdef double[3] w
    cdef double[3] u
    cdef double[3] ground
    cdef double[9] slope
    cdef double norm
    cdef int i, j, m
    out = np.empty((n, 3))
    slopes = np.empty((n if with_slopes else 0, 3, 3))
    cdef double[:, ::1] c = out
    cdef double[:, :, ::1] by = slopes
    for i in range(3):
        ground[i] = velocity[i]
    for k in range(n):
        for i in range(3):
            w[i] = itrs[k, i] + ground[i]
        norm = 1 / sqrt(w[0] * w[0] + w[1] * w[1] + w[2] * w[2])
        for i in range(3):
            w[i] *= norm
        turned(&a4[0, 0], w, v)
        air.bend(v, u)
        for j in range(3):
            c[k, j] = u[0] * g[0, j] + u[1] * g[1, j] + u[2] * g[2, j]
        if with_slopes:
            air.bend_slopes(v, u, slope)
            for j in range(3):
                for m in range(3):
                    by[k, j, m] = g[0, j] * slope[m] + g[1, j] * slope[3 + m] + g[2, j] * slope[6 + m]
    return (out, slopes) if with_slopes else out


cdef double _excess(
    const double[:, ::1] residual, const double[:, :, ::1] covariance, double extra, double share, double median_of_chi2,
    double *d2,
) noexcept nogil:
    """How far the mean squared distance along an axis is above `share`; from the median if median_of_chi2 > 0."""
    cdef int n = residual.shape[0], k
    cdef double xx, xy, yy, x, y, total = 0.0
    for k in range(n):
        x, y = residual[k, 0], residual[k, 1]
        xx, xy, yy = covariance[k, 0, 0] + extra, covariance[k, 0, 1], covariance[k, 1, 1] + extra
        d2[k] = (yy * x * x - 2 * xy * x * y + xx * y * y) / (xx * yy - xy * xy)
        total += d2[k]
    if not median_of_chi2 > 0:
        return total / n / 2 - share
    total = median(d2, n)
    if n % 2 == 0:
        # the largest of the lower half, which stands before it
        x = d2[0]
        for k in range(1, n // 2):
            x = max(x, d2[k])
        total = (total + x) / 2
    return total / median_of_chi2 - share


def extra_variance(
    const double[:, ::1] residual, const double[:, :, ::1] covariance, double share, double median_of_chi2, double high,
    double low, int coarse, int rounds,
):
    """The isotropic variance (px2), from low to high, at which squared residuals are as large as their covariance says.

    residual, covariance  (N, 2) px, (N, 2, 2) px2
    share                 that part of the coordinates which a fit leaves free
    median_of_chi2        of two degrees of freedom: the median counts; 0: the mean
    coarse, rounds        points of a grid, and grids, each between two points of the last one

    0 if they are not larger without it.
    """
    cdef int n = residual.shape[0], turn, k
    cdef double first, last, here, before
    cdef double *d2 = <double *>malloc((n + 1) * sizeof(double))
    try:
        if d2 == NULL:
            raise MemoryError
        if n == 0 or _excess(residual, covariance, 0.0, share, median_of_chi2, d2) <= 0:
            return 0.0
        for turn in range(rounds):
            first, last, before = log(low), log(high), low
            for k in range(coarse):
                here = exp(first + (last - first) * k / (coarse - 1)) if 0 < k < coarse - 1 else high if k else low
                if _excess(residual, covariance, here, share, median_of_chi2, d2) < 0:
                    low, high = before, here
                    break
                before = here
            else:
                return high
        return sqrt(low * high)
    finally:
        free(d2)

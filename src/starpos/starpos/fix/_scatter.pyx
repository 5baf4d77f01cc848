# SPDX-License-Identifier: Apache-2.0
# cython: language_level=3, boundscheck=False, wraparound=False, cdivision=True, initializedcheck=False
"""How much more the residuals of stars scatter than their errors say."""

from libc.math cimport INFINITY, exp, fabs, log
from libc.stdlib cimport free, malloc

import numpy as np

from starpos._numeric.algebra cimport middle
from starpos._numeric.wide cimport wide_void

cdef enum:
    # determinants whose product is a number, points of an integral, steps of a search
    TOGETHER = 8
    POINTS = 128
    MAX_TURNS = 100


cdef inline double distance2_of(
    const double[:, ::1] residual, const double[:, :, ::1] covariance, int k, double extra, double *determinant
) noexcept nogil:
    """The squared residual k in units of its covariance plus an extra isotropic variance, whose determinant is set."""
    cdef double x = residual[k, 0], y = residual[k, 1], xy = covariance[k, 0, 1]
    cdef double xx = covariance[k, 0, 0] + extra, yy = covariance[k, 1, 1] + extra
    determinant[0] = xx * yy - xy * xy
    return (yy * x * x - 2 * xy * x * y + xx * y * y) / determinant[0]


def distances2(const double[:, ::1] residual, const double[:, :, ::1] covariance):
    """Squared residuals (N,) of residual (N, 2) px in units of covariance (N, 2, 2) px2."""
    cdef int k
    cdef double determinant
    fit(residual, covariance)
    out = np.empty(residual.shape[0])
    cdef double[::1] to = out
    for k in range(residual.shape[0]):
        to[k] = distance2_of(residual, covariance, k, 0.0, &determinant)
    return out


def expected_variance(
    const double[:, ::1] residual, const double[:, :, ::1] covariance, double share, double stated, double least,
    double most,
):
    """The mean of the extra variance (px2) of residuals (N, 2) under Jeffreys' prior of the whole one, from least to most.

    share: that part of the coordinates which a fit leaves free.  stated: the variance that is typical of covariance (N, 2, 2).
    """
    cdef int n = residual.shape[0], g, k
    cdef double[POINTS] extra
    cdef double[POINTS] total
    cdef double[POINTS] product
    cdef double[POINTS] units
    cdef double step = log(most / least) / (POINTS - 1), best, density, whole = 0.0, mean = 0.0
    fit(residual, covariance)
    for g in range(POINTS):
        extra[g], total[g], product[g] = least * exp(g * step), 0.0, 1.0
        # of determinants: they are alike then, and their products neither too large nor too small for a number
        units[g] = 1 / (stated + extra[g]) / (stated + extra[g])
    for k in range(n):
        _add(&residual[k, 0], &covariance[k, 0, 0], extra, units, total, product)
        # a logarithm for several determinants
        if k % TOGETHER == TOGETHER - 1 or k == n - 1:
            for g in range(POINTS):
                total[g] -= 0.5 * share * log(product[g])
                product[g] = 1.0
    best = -INFINITY
    for g in range(POINTS):
        # points lie evenly in the logarithm of the extra variance
        total[g] += log(extra[g] / (stated + extra[g])) - share * n * log(stated + extra[g])
        best = max(best, total[g])
    for g in range(POINTS):
        density = exp(total[g] - best)
        whole += density
        mean += density * extra[g]
    return mean / whole


cdef wide_void _add(
    const double *residual, const double *covariance, const double *extra, const double *units, double *total, double *product
) noexcept nogil:
    """Take half of a residual's squared distance from totals, and multiply products by its determinant, for each extra variance."""
    cdef double x2 = residual[0] * residual[0], y2 = residual[1] * residual[1], xy = covariance[1]
    cdef double twice = 2 * xy * residual[0] * residual[1], xx, yy, determinant
    cdef int g
    for g in range(POINTS):
        xx, yy = covariance[0] + extra[g], covariance[3] + extra[g]
        determinant = xx * yy - xy * xy
        total[g] -= 0.5 * (yy * x2 - twice + xx * y2) / determinant
        product[g] *= determinant * units[g]


def sifted(
    const double[:, ::1] residual, const double[:, :, ::1] covariance, const unsigned char[::1] keep, double share,
    double median_of_chi2, double most2, double least, double good,
):
    """The extra variance (px2) of those residuals that are kept (N,), and which of all (N,) go with them.

    It is isotropic: under it the squared residuals (N, 2) px are as large as their covariance (N, 2, 2) px2 says; 0 if they
    never are larger.

    share                  that part of the coordinates which a fit leaves free
    median_of_chi2, most2  of two degrees of freedom; and what squared residuals do not exceed that go with the others, under
                           the variance that the median asks for
    least, good            the least variance as a share of the most, and the share to which it is found
    """
    cdef int n = residual.shape[0], k
    cdef double determinant, extra, typical
    cdef Columns kept
    cdef double *room = columns_of(residual, covariance, keep, &kept)
    try:
        extra = searched(&kept, share, 0.0, least, good)
        # the gate goes by the median: by the mean an outlier among a dozen stars would widen it enough to pass
        typical = searched(&kept, share, median_of_chi2, least, good)
    finally:
        free(room)
    out = np.empty(n, bool)
    cdef unsigned char[::1] to = out.view(np.uint8)
    for k in range(n):
        to[k] = distance2_of(residual, covariance, k, typical, &determinant) < most2
    return extra, out


cdef struct Columns:
    # n residuals, their squares and twice their product, their covariances, and room for as many distances
    int n
    double *x2
    double *y2
    double *twice
    double *xx
    double *xy
    double *yy
    double *d2


cdef double *columns_of(
    const double[:, ::1] residual, const double[:, :, ::1] covariance, const unsigned char[::1] keep, Columns *c
) except NULL:
    """Set c to the residuals that are kept (N,); what is returned holds its numbers."""
    cdef Py_ssize_t n = residual.shape[0], k
    fit(residual, covariance)
    if keep.shape[0] != n:
        raise ValueError(f"a mask of {keep.shape[0]} for {n} residuals")
    cdef double *room = <double *>malloc((7 * n + 1) * sizeof(double))
    if room == NULL:
        raise MemoryError
    c.n = 0
    c.x2, c.y2, c.twice, c.xx, c.xy, c.yy, c.d2 = (
        room, room + n, room + 2 * n, room + 3 * n, room + 4 * n, room + 5 * n, room + 6 * n
    )
    for k in range(n):
        if keep[k]:
            c.x2[c.n], c.y2[c.n] = residual[k, 0] * residual[k, 0], residual[k, 1] * residual[k, 1]
            c.twice[c.n] = 2 * residual[k, 0] * residual[k, 1]
            c.xx[c.n], c.xy[c.n], c.yy[c.n] = covariance[k, 0, 0], covariance[k, 0, 1], covariance[k, 1, 1]
            c.n += 1
    return room


cdef int fit(const double[:, ::1] residual, const double[:, :, ::1] covariance) except -1:
    """Raise ValueError unless residuals are (N, 2) and covariances (N, 2, 2)."""
    cdef Py_ssize_t n = residual.shape[0]
    if residual.shape[1] != 2 or covariance.shape[0] != n or covariance.shape[1] != 2 or covariance.shape[2] != 2:
        raise ValueError(f"residuals ({n}, {residual.shape[1]}) and {covariance.shape[0]} covariances: (N, 2) and (N, 2, 2)")
    return 0


cdef double searched(Columns *c, double share, double median_of_chi2, double least, double good) noexcept nogil:
    """The extra variance as `sifted` has it; from the median if median_of_chi2 > 0, else from the mean."""
    cdef double here, there = 0.0, low, high = 1e-12, above, before, falls = 1.0
    cdef int turn, k
    if c.n == 0 or size(c, 0.0, median_of_chi2) <= share:
        return 0.0
    for k in range(c.n):
        high += 8 * (c.x2[k] + c.y2[k])
    # the logarithm of the size falls with that of the variance: not at all at first, at last as fast
    before, here = log(size(c, high, median_of_chi2) / share), log(high)
    low, high = here + log(least), here
    for turn in range(MAX_TURNS):
        there = here + before / falls
        if not (low < there < high):
            there = (low + high) / 2
        above = log(size(c, exp(there), median_of_chi2) / share)
        if above > 0:
            low = there
        else:
            high = there
        falls = min(max((before - above) / (there - here), 1e-3), 1.0)
        if fabs(there - here) < good or high - low < good:
            break
        here, before = there, above
    return exp(there)


cdef wide_void _distances(
    const double *x2, const double *y2, const double *twice, const double *xx, const double *xy, const double *yy, double extra,
    int n, double *d2
) noexcept nogil:
    """Squared distances (n,) of residuals under a variance that is added to theirs."""
    cdef int k
    cdef double x, y
    for k in range(n):
        x, y = xx[k] + extra, yy[k] + extra
        d2[k] = (y * x2[k] - twice[k] * xy[k] + x * y2[k]) / (x * y - xy[k] * xy[k])


cdef double size(Columns *c, double extra, double median_of_chi2) noexcept nogil:
    """The mean squared distance along an axis under an extra variance; from the median if median_of_chi2 > 0."""
    cdef double total = 0.0
    cdef int k
    _distances(c.x2, c.y2, c.twice, c.xx, c.xy, c.yy, extra, c.n, c.d2)
    if median_of_chi2 > 0:
        return middle(c.d2, c.n) / median_of_chi2
    for k in range(c.n):
        total += c.d2[k]
    return total / c.n / 2

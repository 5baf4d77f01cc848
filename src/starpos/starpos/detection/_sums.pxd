# SPDX-License-Identifier: Apache-2.0
# cython: boundscheck=False, wraparound=False, cdivision=True, initializedcheck=False
# The pixels of a star that is fitted, sums over them, and the normal equations of a fit, whose unknowns differ by powers of ten.

from libc.math cimport NAN, sqrt
from libc.string cimport memset

from starpos._numeric.wide cimport fused_void, lanes, sum_of, wide_void


cdef inline wide_void copy_pixels(
    const float *signal, const float *noise, const unsigned char *good, const unsigned char *outlier, int place, int n, int step,
    double x, double y, int *places, double *dx, double *dy, double *own_signal, double *noise2, double *weight,
) noexcept nogil:
    """Copy n pixels of a row, each `step` (1 or 2) after the one before.

    That is their light, squared noise, whether they are good and no outliers, places in the stamp from `place` on, and offsets.
    """
    cdef int j
    if step == 1:
        for j in range(n):
            own_signal[j], noise2[j], weight[j] = signal[j], <double>noise[j] * noise[j], good[j] & ~outlier[j]
    else:
        for j in range(n):
            own_signal[j], noise2[j] = signal[2 * j], <double>noise[2 * j] * noise[2 * j]
            weight[j] = good[2 * j] & ~outlier[2 * j]
    for j in range(n):
        places[j], dx[j], dy[j] = place + j * step, x + j * step, y


cdef inline fused_void weigh(
    const double *signal, const double *noise2, const double *value, double flux, double dn_per_photon, double misfit2, int n,
    double *weight, double *residual,
) noexcept nogil:
    """Set what a star of this flux leaves of n pixels, and divide their weights by the variance of sky and light."""
    cdef int p
    cdef double light, some
    for p in range(n):
        light = flux * value[p]
        some = light if light > 0 else 0.0
        residual[p] = signal[p] - light
        weight[p] /= noise2[p] + dn_per_photon * some + misfit2 * some * some


cdef inline void sky_sums(
    const double *weight, const double *noise2, const double *f, const double *signal, int n, double *out
) noexcept nogil:
    """Sums over n pixels of their PSF squared and times the signal, with the weights over the sky's variance."""
    cdef int p
    cdef double each
    out[0] = out[1] = 0.0
    for p in range(n):
        each = weight[p] / noise2[p] * f[p]
        out[0] += each * f[p]
        out[1] += each * signal[p]


cdef inline double chi_square(const double *weight, const double *residual, int n) noexcept nogil:
    """The sum over n pixels of their squared residuals times the weights."""
    cdef double total = 0.0
    cdef int p
    for p in range(n):
        total += weight[p] * residual[p] * residual[p]
    return total


cdef inline wide_void any_bright(const double *weight, const double *residual, double limit2, int n, bint *found) noexcept nogil:
    """Whether one of n pixels has no weight, or is above the model by more than so many squared sigmas."""
    cdef long long any_ = 0
    cdef int p
    for p in range(n):
        any_ |= (weight[p] == 0) | ((residual[p] > 0) & (residual[p] * residual[p] * weight[p] > limit2))
    found[0] = any_ != 0


cdef inline fused_void squares(
    const double *weight, const double *x, const double *y, const double *f, const double *form, int n, double *out
) noexcept nogil:
    """Set `out` to the weight of each of n pixels times a quadratic form xx, xy, yy, xf, yf, ff."""
    cdef double xx = form[0], xy = 2 * form[1], yy = form[2], xf = 2 * form[3], yf = 2 * form[4], ff = form[5]
    cdef int p
    for p in range(n):
        out[p] = weight[p] * (
            x[p] * (xx * x[p] + xy * y[p] + xf * f[p]) + y[p] * (yy * y[p] + yf * f[p]) + ff * f[p] * f[p]
        )


cdef inline fused_void products(
    const double *weight, const double *x, const double *y, const double *f, const double *r, int n, double *out
) noexcept nogil:
    """Products with the weights, summed over n pixels: xx, xy, yy, xf, yf, ff, xr, yr, fr."""
    cdef const double *one[9]
    cdef const double *other[9]
    cdef lanes[9] sums
    cdef lanes w, a, b, c, wa, wb, wr
    cdef int p, k
    memset(sums, 0, sizeof(sums))
    for p in range(0, n - 3, 4):
        w, a = (<const lanes *>(weight + p))[0], (<const lanes *>(x + p))[0]
        b, c = (<const lanes *>(y + p))[0], (<const lanes *>(f + p))[0]
        wa, wb, wr = w * a, w * b, w * (<const lanes *>(r + p))[0]
        sums[0] += wa * a
        sums[1] += wa * b
        sums[2] += wb * b
        sums[3] += wa * c
        sums[4] += wb * c
        sums[5] += w * c * c
        sums[6] += wr * a
        sums[7] += wr * b
        sums[8] += wr * c
    one[0], one[1], one[2], one[3], one[4], one[5], one[6], one[7], one[8] = x, x, y, x, y, f, x, y, f
    other[0], other[1], other[2], other[3], other[4], other[5], other[6], other[7], other[8] = x, y, y, f, f, f, r, r, r
    for k in range(9):
        out[k] = sum_of(&sums[k])
        for p in range(n // 4 * 4, n):
            out[k] += weight[p] * one[k][p] * other[k][p]


cdef inline fused_void cross_products(
    const double *weight, const double **one, const double **other, int n, double *out
) noexcept nogil:
    """Products of three columns with three others and the weights, summed over n pixels: ad, ae, af, bd, be, bf, cd, ce, cf."""
    cdef lanes[9] sums
    cdef lanes wa
    cdef int a, b, p
    memset(sums, 0, sizeof(sums))
    for p in range(0, n - 3, 4):
        for a in range(3):
            wa = (<const lanes *>(weight + p))[0] * (<const lanes *>(one[a] + p))[0]
            for b in range(3):
                sums[3 * a + b] += wa * (<const lanes *>(other[b] + p))[0]
    for a in range(3):
        for b in range(3):
            out[3 * a + b] = sum_of(&sums[3 * a + b])
            for p in range(n // 4 * 4, n):
                out[3 * a + b] += weight[p] * one[a][p] * other[b][p]


cdef enum:
    # Unknowns: two stars with x, y, flux, and a gain for each of four phases.
    LARGEST = 14


cdef inline bint scaled_factor(double *normal, int n, double *scale) noexcept nogil:
    """Factor the lower half of normal (n, n), scaled, because fluxes are a million times larger than pixels; False if singular.

    Cholesky's factor, with 1 over its diagonal in place of that: divisions take long.
    """
    cdef double determinant = 1.0, value
    cdef int a, b, k
    for a in range(n):
        scale[a] = 1 / sqrt(normal[a * n + a])
        for b in range(a + 1):
            value = normal[a * n + b] * scale[a] * scale[b]
            for k in range(b):
                value -= normal[a * n + k] * normal[b * n + k]
            if b < a:
                normal[a * n + b] = value * normal[b * n + b]
            elif value > 0:
                determinant *= value
                normal[a * n + a] = 1 / sqrt(value)
            else:
                return False
    # equations whose scaled determinant is smaller have no solution
    return determinant > 1e-9


cdef inline void invert_scaled(const double *factor, int n, const double *scale, double *out) noexcept nogil:
    """Set `out` (n, n) to the inverse of equations by their scaled factor (n, n)."""
    # the factor's inverse, which is a lower half too
    cdef double[LARGEST * LARGEST] half
    cdef double value
    cdef int a, b, k
    for b in range(n):
        half[b * n + b] = factor[b * n + b]
        for a in range(b + 1, n):
            value = 0.0
            for k in range(b, a):
                value -= factor[a * n + k] * half[k * n + b]
            half[a * n + b] = value * factor[a * n + a]
    for a in range(n):
        for b in range(a + 1):
            value = 0.0
            for k in range(a, n):
                value += half[k * n + a] * half[k * n + b]
            out[a * n + b] = out[b * n + a] = value * scale[a] * scale[b]


cdef inline void solve_scaled(const double *factor, int n, const double *scale, double *right) noexcept nogil:
    """Replace right (n,) by the solution of equations by their scaled factor (n, n)."""
    cdef int a, k
    for a in range(n):
        right[a] *= scale[a]
        for k in range(a):
            right[a] -= factor[a * n + k] * right[k]
        right[a] *= factor[a * n + a]
    for a in range(n - 1, -1, -1):
        for k in range(a + 1, n):
            right[a] -= factor[k * n + a] * right[k]
        right[a] *= factor[a * n + a]
    for a in range(n):
        right[a] *= scale[a]


cdef inline bint invert(double *normal, int n, double *out) noexcept nogil:
    """Set `out` (n, n) to the inverse of the lower half of normal (n, n), NaN if singular; whether it is not."""
    cdef double[LARGEST] scale
    cdef int a
    if scaled_factor(normal, n, scale):
        invert_scaled(normal, n, scale, out)
        return True
    for a in range(n * n):
        out[a] = NAN
    return False

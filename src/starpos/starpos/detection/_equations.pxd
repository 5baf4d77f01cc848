# SPDX-License-Identifier: Apache-2.0
# cython: boundscheck=False, wraparound=False, cdivision=True, initializedcheck=False
# Normal equations of a least-squares fit, whose unknowns differ by powers of ten.

from libc.math cimport NAN, sqrt

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

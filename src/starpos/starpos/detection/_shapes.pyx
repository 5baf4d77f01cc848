# SPDX-License-Identifier: Apache-2.0
# cython: language_level=3, boundscheck=False, wraparound=False, cdivision=True, initializedcheck=False
"""Covariances of two dimensions, many at once: closed forms of what takes a library longer to begin than to do."""

from libc.math cimport isfinite, sqrt

import numpy as np


cdef Py_ssize_t _count(const double[:, :, ::1] one, const double[:, :, ::1] other, const double[:, :, ::1] more) except -1:
    """How many matrices (2, 2) there are; ValueError unless all are as many, or one."""
    cdef Py_ssize_t n = max(one.shape[0], other.shape[0], more.shape[0])
    if 0 in (one.shape[0], other.shape[0], more.shape[0]):
        n = 0
    for count, rows, columns in (
        (one.shape[0], one.shape[1], one.shape[2]),
        (other.shape[0], other.shape[1], other.shape[2]),
        (more.shape[0], more.shape[1], more.shape[2]),
    ):
        if count not in (1, n) or (rows, columns) != (2, 2):
            raise ValueError(f"{count} matrices of {rows} x {columns}: {n} of 2 x 2 are needed, or one")
    return n


def inverted(const double[:, :, ::1] shape):
    """Inverses of covariances (N, 2, 2)."""
    cdef Py_ssize_t n = _count(shape, shape, shape), k
    out = np.empty((n, 2, 2))
    cdef double[:, :, ::1] found = out
    with nogil:
        for k in range(n):
            put_shape(found, k, inverse(shape_of(shape, k)))
    return out


def squared_widths(const double[:, :, ::1] shape):
    """Eigenvalues (N, 2) of covariances (N, 2, 2), the smaller first."""
    cdef Py_ssize_t n = _count(shape, shape, shape), k
    out = np.empty((n, 2))
    cdef double[:, ::1] width = out
    with nogil:
        for k in range(n):
            width[k, 0], width[k, 1] = sides(shape_of(shape, k))
    return out


def clipped(const double[:, :, ::1] shape, double least, double most, double exponent):
    """Covariances (N, 2, 2) with eigenvalues of at least and at most so much, to a power."""
    cdef Py_ssize_t n = _count(shape, shape, shape), k
    out = np.empty((n, 2, 2))
    cdef double[:, :, ::1] found = out
    with nogil:
        for k in range(n):
            put_shape(found, k, clipped_to(shape_of(shape, k), least, most, exponent))
    return out


def through(const double[:, :, ::1] shape, const double[:, :, ::1] window):
    """Covariances (N, 2, 2) of the images of stars of covariance `shape` through windows, each (N, 2, 2) or (1, 2, 2)."""
    cdef Py_ssize_t n = _count(shape, window, window), k
    cdef Shape a, b
    out = np.empty((n, 2, 2))
    cdef double[:, :, ::1] found = out
    with nogil:
        for k in range(n):
            a, b = inverse(shape_of(shape, k)), inverse(shape_of(window, k))
            put_shape(found, k, inverse(Shape(a.xx + b.xx, a.xy + b.xy, a.yy + b.yy)))
    return out


def before(const double[:, :, ::1] seen, const double[:, :, ::1] window):
    """Covariances (N, 2, 2) of stars whose images through windows are seen; NaN where none is. The reverse of `through`."""
    cdef Py_ssize_t n = _count(seen, window, window), k
    out = np.empty((n, 2, 2))
    cdef double[:, :, ::1] found = out
    with nogil:
        for k in range(n):
            put_shape(found, k, shape_before(shape_of(seen, k), shape_of(window, k)))
    return out


def relative(const double[:, :, ::1] seen, const double[:, :, ::1] expected):
    """The smaller and the larger squared width (N, 2) of images, over those of expected ones; 0 for what is not a number."""
    cdef Py_ssize_t n = _count(seen, expected, expected), k
    cdef double a, b, c
    cdef Shape s, e
    out = np.zeros((n, 2))
    cdef double[:, ::1] width = out
    with nogil:
        for k in range(n):
            s, e = shape_of(seen, k), shape_of(expected, k)
            # by the Cholesky factor of the expected one, a 0, b c
            a = sqrt(e.xx)
            b = e.xy / a
            c = sqrt(e.yy - b * b)
            s.xx, s.xy = s.xx / (a * a), (s.xy - b * s.xx / a) / (a * c)
            s.yy = (s.yy - 2 * b * c * s.xy - b * b * s.xx) / (c * c)
            if isfinite(s.xx + s.xy + s.yy):
                width[k, 0], width[k, 1] = sides(s)
    return out

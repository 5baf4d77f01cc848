# SPDX-License-Identifier: Apache-2.0
# cython: language_level=3, boundscheck=False, wraparound=False, cdivision=True, initializedcheck=False
"""Covariances of two dimensions, many at once: closed forms of what takes a library longer to begin than to do."""

from libc.math cimport NAN, fabs, hypot, isfinite, pow, sqrt

import numpy as np


cdef struct Shape:
    double xx
    double xy
    double yy


cdef inline Shape _of(const double[:, :, ::1] each, Py_ssize_t k) noexcept nogil:
    """The matrix of star k; a single one serves any star."""
    cdef Py_ssize_t j = k if each.shape[0] > 1 else 0
    return Shape(each[j, 0, 0], (each[j, 0, 1] + each[j, 1, 0]) / 2, each[j, 1, 1])


cdef inline double _volume(Shape s) noexcept nogil:
    return s.xx * s.yy - s.xy * s.xy


cdef inline Shape _inverse(Shape s) noexcept nogil:
    cdef double volume = _volume(s)
    return Shape(s.yy / volume, -s.xy / volume, s.xx / volume)


cdef inline (double, double) _sides(Shape s) noexcept nogil:
    """The eigenvalues, the smaller first."""
    cdef double middle = (s.xx + s.yy) / 2, half = hypot((s.xx - s.yy) / 2, s.xy)
    return middle - half, middle + half


cdef inline Shape _with_sides(Shape s, double narrow, double wide) noexcept nogil:
    """The matrix with the same eigenvectors and these eigenvalues."""
    cdef double half = hypot((s.xx - s.yy) / 2, s.xy), middle = (narrow + wide) / 2, scale
    if half == 0:
        return Shape(narrow, 0.0, wide)
    scale = (wide - narrow) / (2 * half)
    return Shape(middle + scale * (s.xx - s.yy) / 2, scale * s.xy, middle - scale * (s.xx - s.yy) / 2)


cdef inline void _put(double[:, :, ::1] out, Py_ssize_t k, Shape s) noexcept nogil:
    out[k, 0, 0], out[k, 0, 1], out[k, 1, 0], out[k, 1, 1] = s.xx, s.xy, s.xy, s.yy


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
            _put(found, k, _inverse(_of(shape, k)))
    return out


def clipped(const double[:, :, ::1] shape, double least, double most, double exponent):
    """Covariances (N, 2, 2) with eigenvalues of at least and at most so much, to a power."""
    cdef Py_ssize_t n = _count(shape, shape, shape), k
    cdef double narrow, wide
    cdef Shape s
    out = np.empty((n, 2, 2))
    cdef double[:, :, ::1] found = out
    with nogil:
        for k in range(n):
            s = _of(shape, k)
            narrow, wide = _sides(s)
            narrow, wide = max(least, min(narrow, most)), max(least, min(wide, most))
            if exponent != 1:
                narrow, wide = pow(narrow, exponent), pow(wide, exponent)
            _put(found, k, _with_sides(s, narrow, wide))
    return out


def through(const double[:, :, ::1] shape, const double[:, :, ::1] window):
    """Covariances (N, 2, 2) of the images of stars of covariance `shape` through windows, each (N, 2, 2) or (1, 2, 2)."""
    cdef Py_ssize_t n = _count(shape, window, window), k
    cdef Shape a, b
    out = np.empty((n, 2, 2))
    cdef double[:, :, ::1] found = out
    with nogil:
        for k in range(n):
            a, b = _inverse(_of(shape, k)), _inverse(_of(window, k))
            _put(found, k, _inverse(Shape(a.xx + b.xx, a.xy + b.xy, a.yy + b.yy)))
    return out


def before(const double[:, :, ::1] seen, const double[:, :, ::1] window):
    """Covariances (N, 2, 2) of stars whose images through windows are seen; NaN where none is. The reverse of `through`."""
    cdef Py_ssize_t n = _count(seen, window, window), k
    cdef Shape s, a, b
    out = np.empty((n, 2, 2))
    cdef double[:, :, ::1] found = out
    with nogil:
        for k in range(n):
            s, b = _of(seen, k), _inverse(_of(window, k))
            if isfinite(s.xx + s.xy + s.yy) and fabs(_volume(s)) > 1e-6:
                a = _inverse(s)
                s = Shape(a.xx - b.xx, a.xy - b.xy, a.yy - b.yy)
                if fabs(_volume(s)) > 1e-9:
                    _put(found, k, _inverse(s))
                    continue
            _put(found, k, Shape(NAN, NAN, NAN))
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
            s, e = _of(seen, k), _of(expected, k)
            # by the Cholesky factor of the expected one, a 0, b c
            a = sqrt(e.xx)
            b = e.xy / a
            c = sqrt(e.yy - b * b)
            s.xx, s.xy = s.xx / (a * a), (s.xy - b * s.xx / a) / (a * c)
            s.yy = (s.yy - 2 * b * c * s.xy - b * b * s.xx) / (c * c)
            if isfinite(s.xx + s.xy + s.yy):
                width[k, 0], width[k, 1] = _sides(s)
    return out

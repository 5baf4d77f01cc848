# SPDX-License-Identifier: Apache-2.0
# cython: language_level=3, boundscheck=False, wraparound=False, cdivision=True, initializedcheck=False
"""What the pixels beside a peak tell: whether it is a hot pixel, and what the sky is like around it.

Peaks x, y (N,) px are on a plane (h, w); a pixel beyond the frame is the nearest one on it. level, noise (N, P) DN are of the
sky at each, P = 1, or 4 for the phases of a colour mosaic. There are many peaks, so that their stamps are not kept.
"""

from libc.math cimport sqrt
from libc.stdlib cimport free, malloc

import numpy as np

from starpos._numeric.algebra cimport fetch, level_and_scatter
from starpos._numeric.limits cimport inside

ctypedef unsigned char unsigned_char

ctypedef fused pixel_t:
    unsigned_char
    unsigned short


cdef inline int _phase(Py_ssize_t row, Py_ssize_t column, int phases) noexcept nogil:
    """The number of a pixel in the mosaic's pattern."""
    return <int>(2 * (row & 1) + (column & 1)) if phases > 1 else 0


cdef void _fetched(const pixel_t[:, ::1] plane, Py_ssize_t x, Py_ssize_t y, int reach) noexcept nogil:
    """Ask for the ends of the rows around a peak, because peaks are in no order."""
    cdef Py_ssize_t row
    cdef int i
    for i in range(-reach, reach + 1):
        row = inside(y + i, plane.shape[0])
        fetch(&plane[row, inside(x - reach, plane.shape[1])])
        fetch(&plane[row, inside(x + reach, plane.shape[1])])


cdef int _sound(
    const Py_ssize_t *size, Py_ssize_t n, Py_ssize_t rows, const Py_ssize_t *level, const Py_ssize_t *noise
) except -1:
    if not (rows == level[0] == noise[0] == n and level[1] == noise[1] and level[1] in (1, 4)):
        raise ValueError("a row, and a level and noise for each of 1 or 4 phases, are needed for each column of a peak")
    if not (size[0] and size[1]):
        raise ValueError(f"peaks of a frame of {size[1]} x {size[0]} px: there is nothing to see")
    return 0


def dots(
    const pixel_t[:, ::1] plane, const Py_ssize_t[::1] x, const Py_ssize_t[::1] y, const float[:, ::1] level, double half,
    double quarter,
):
    """Whether peaks (N,) are one or two hot pixels: the others of the nine around each have little of the brightest's light.

    half     share of it that all but the brightest have together
    quarter  and all but the two brightest
    """
    cdef Py_ssize_t n = x.shape[0], k, row, column
    cdef int phases = level.shape[1], i, j
    cdef double light, first, second, sum_
    _sound(plane.shape, n, y.shape[0], level.shape, level.shape)
    out = np.empty(n, np.uint8)
    cdef unsigned char[::1] dot = out
    with nogil:
        for k in range(n):
            if k + 1 < n:
                _fetched(plane, x[k + 1], y[k + 1], 1)
            first = second = -1e300
            sum_ = 0.0
            for i in range(-1, 2):
                row = inside(y[k] + i, plane.shape[0])
                for j in range(-1, 2):
                    column = inside(x[k] + j, plane.shape[1])
                    light = plane[row, column] - level[k, _phase(y[k] + i, x[k] + j, phases)]
                    sum_ += light
                    second = max(second, min(light, first))
                    first = max(first, light)
            dot[k] = sum_ - first < half * first or sum_ - first - second < quarter * first
    return out.view(bool)


def lonely(
    const pixel_t[:, ::1] plane, const Py_ssize_t[::1] x, const Py_ssize_t[::1] y, const float[:, ::1] level,
    const float[:, ::1] noise, int reach, double share, double sigmas,
):
    """Whether the squares of (2 reach + 1) px around peaks (N,) have almost no light beside their brightest pixel's.

    That is less than this share of it and than so many sigma of the sky's noise.
    """
    cdef Py_ssize_t n = x.shape[0], k, row, column
    cdef int phases = level.shape[1], i, j, phase
    cdef double light, first, sum_, variance
    _sound(plane.shape, n, y.shape[0], level.shape, noise.shape)
    out = np.empty(n, np.uint8)
    cdef unsigned char[::1] alone = out
    with nogil:
        for k in range(n):
            if k + 1 < n:
                _fetched(plane, x[k + 1], y[k + 1], reach)
            first, sum_, variance = -1e300, 0.0, 0.0
            for i in range(-reach, reach + 1):
                row = inside(y[k] + i, plane.shape[0])
                for j in range(-reach, reach + 1):
                    column, phase = inside(x[k] + j, plane.shape[1]), _phase(y[k] + i, x[k] + j, phases)
                    light = plane[row, column] - level[k, phase]
                    sum_ += light
                    first = max(first, light)
                    variance += <double>noise[k, phase] * noise[k, phase]
            alone[k] = sum_ - first < min(share * first, sigmas * sqrt(variance))
    return out.view(bool)


def rims(
    const pixel_t[:, ::1] plane, const Py_ssize_t[::1] x, const Py_ssize_t[::1] y, const float[:, ::1] level,
    const float[:, ::1] noise, int reach, double per_mad, double raised, double uneven,
):
    """Median (N,) and scatter (N,), over the noise, of the light along the edges of squares, reach px from peaks (N,).

    per_mad         sigma over the median of the absolute differences
    raised, uneven  median and scatter are 0 and 1 where they are not above these
    """
    cdef Py_ssize_t n = x.shape[0], k, row, column
    cdef int side = 2 * reach, phases = level.shape[1], i, j, phase
    cdef double sky, spread
    _sound(plane.shape, n, y.shape[0], level.shape, noise.shape)
    if reach < 1:
        raise ValueError(f"squares of {reach} px have no edge: give 1 or more")
    out = np.empty((2, n))
    cdef double[:, ::1] found = out
    cdef double *score = <double *>malloc(4 * side * sizeof(double))
    if score == NULL:
        raise MemoryError
    with nogil:
        for k in range(n):
            if k + 1 < n:
                _fetched(plane, x[k + 1], y[k + 1], reach)
            for j in range(4 * side):
                # from corner to corner: along the top, down the right side, and back
                i = j % side - reach
                if j // side == 0:
                    row, column = y[k] - reach, x[k] + i
                elif j // side == 1:
                    row, column = y[k] + i, x[k] + reach
                elif j // side == 2:
                    row, column = y[k] + reach, x[k] - i
                else:
                    row, column = y[k] - i, x[k] - reach
                row, column = inside(row, plane.shape[0]), inside(column, plane.shape[1])
                phase = _phase(row, column, phases)
                score[j] = <double>(<float>plane[row, column] - level[k, phase]) / noise[k, phase]
            sky, spread = level_and_scatter(score, 4 * side, per_mad, uneven)
            found[0, k], found[1, k] = sky if sky > raised else 0.0, spread
    free(score)
    return out[0], out[1]
